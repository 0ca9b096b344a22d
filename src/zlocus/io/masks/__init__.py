"""Masks of images: pixels that show no ground, from rasters, polygons and the files of vendors.

`mask_entry` is the entry of a scene file, `image_mask` what it becomes, `open_mask` the way from one to the other.
"""
