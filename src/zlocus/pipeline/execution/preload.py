"""Imports that all workers need, made once by the process that workers are forked from."""

from zlocus.matching import tile

__all__ = ["tile"]
