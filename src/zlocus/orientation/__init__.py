"""Tie points, pointing corrections and the height range of the ground (method section 1)."""
