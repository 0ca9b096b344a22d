"""Surfaces from images by multi-view vertical line locus matching."""

__version__ = "0.1.0"
