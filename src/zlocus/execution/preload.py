"""What workers need, imported once by the process that they are forked from."""

from zlocus import tile

__all__ = ["tile"]
