"""What workers need, imported once by the process that they are forked from."""

from zlocus.matching import tile

__all__ = ["tile"]
