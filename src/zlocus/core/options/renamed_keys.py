"""Configuration keys that earlier versions used, and the keys that replace them.

A configuration file with an old key is refused with a message that names the new key.
"""

# Old key, with the names of its groups, and the new key.
RENAMED_KEYS: dict[str, str] = {
    "measure": "cost",
    "measure.small_window": "cost.small_window",
    "measure.large_window": "cost.large_window",
    "measure.few_views": "cost.max_images_for_large_window",
    "measure.noise": "cost.noise_deviation",
    "measure.grey_weight": "cost.grey_weight",
    "measure.grey_weight_two": "cost.grey_weight_two_images",
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
}
