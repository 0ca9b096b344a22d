"""Configuration keys that earlier versions used: those that were renamed, and those that are gone.

A configuration file with an old key is refused with a message that names the new key, or says that there is none.
"""

# Old key, with the names of its groups, and the new key.
RENAMED_KEYS: dict[str, str] = {
    "products.contour_least_cells": "products.min_contour_cells",
    "measure": "cost",
    "measure.small_window": "cost.small_window",
    "measure.large_window": "cost.large_window",
    "measure.few_views": "cost.max_images_for_large_window",
    "measure.noise": "cost.noise_deviation",
    "measure.grey_weight": "cost.grey_weight",
    "measure.grey_reach": "cost.max_grey_difference",
    "measure.hidden_excused": "cost.occluded_pairs_excluded",
    "measure.hidden_margin_steps": "cost.occlusion_margin_steps",
    "selection.rival_px": "selection.second_peak_distance_px",
    "selection.negative_rival": "selection.negative_second_peak",
    "selection.least_seen": "selection.min_visible_share",
    "selection.widest": "selection.max_radii",
    "selection.sigma_steps": "selection.max_sigma_steps",
    "selection.least_worth": "selection.min_label_share",
    "selection.fewest_views": "selection.min_images_for_choice",
    "selection.least_images": "selection.min_images",
    "selection.most_images": "selection.max_images",
    "selection.candidates": "selection.max_candidates",
    "selection.least_overlap": "selection.min_overlap",
    "selection.least_angle_deg": "selection.min_angle_deg",
    "selection.most_angle_deg": "selection.max_angle_deg",
    "pyramid.reach": "pyramid.neighbour_cells",
    "pyramid.finest_rounds": "pyramid.finest_level_rounds",
    "pyramid.coarsest_steps": "pyramid.max_coarsest_steps",
    "planes.least_cells": "planes.min_cells",
    "planes.most_cells": "planes.max_cells",
    "planes.longest_cells": "planes.max_length_cells",
    "planes.least_filled": "planes.min_filled_share",
    "planes.most_cost": "planes.max_cost",
    "planes.least_near": "planes.min_near_share",
    "planes.most_slope_steps": "planes.max_slope_steps",
    "checks.least_ncc": "checks.min_ncc",
    "checks.doubtful_ncc": "checks.weak_ncc",
    "checks.rival_cost": "checks.min_uniqueness",
    "checks.most_spread_steps": "checks.max_overlap_edge_sigma_steps",
    "checks.most_sigma_m": "checks.max_sigma_m",
    "refine.reach_steps": "refine.max_correction_steps",
    "semiglobal.level_easing": "semiglobal.penalty_factor_per_level",
    "orientation.joint": "orientation.bundle_adjustment",
    "orientation.joint.rpc": "orientation.bundle_adjustment.rpc_correction",
    "orientation.joint.drift_s": "orientation.bundle_adjustment.drift_knot_interval_s",
    "orientation.least_ncc": "orientation.min_ncc",
    "orientation.prior_px": "orientation.sigma_shift_px",
}

# Keys that are no longer options, because nobody had a reason to change their values, with the value that always
# applies.
REMOVED_KEYS: dict[str, str] = {
    "measure.grey_weight_two": "0.3 times cost.grey_weight",
    "cost.grey_weight_two_images": "0.3 times cost.grey_weight",
    "semiglobal.p1_two": "semiglobal.p1",
    "semiglobal.p1_two_images": "semiglobal.p1",
    "semiglobal.edge_contrast_two": "4 times semiglobal.edge_contrast",
    "semiglobal.edge_contrast_two_images": "4 times semiglobal.edge_contrast",
    "orientation.match_ratio": "0.8",
    "orientation.patch_px": "9 px",
    "products.ground_cell_m": "1 m",
    "products.ground_scaling": "1.25 m",
}
