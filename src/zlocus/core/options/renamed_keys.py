"""Configuration keys that earlier versions used, and the keys that replace them.

A configuration file with an old key is refused with a message that names the new key.
"""

# Old key, with the names of its groups, and the new key.
RENAMED_KEYS: dict[str, str] = {}
