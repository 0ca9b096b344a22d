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
}
