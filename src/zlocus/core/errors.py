"""One family of errors: every message says what, where and what to do next."""

from __future__ import annotations


class ZlocusError(Exception):
    """Anything zlocus can explain in one sentence; `exit_status` is what the command line returns."""

    exit_status = 1


class InputError(ZlocusError):
    """A file that is missing, damaged, not an image, or without a usable camera."""

    exit_status = 2


class ConfigError(ZlocusError):
    """An option out of range, unknown, or in conflict with another."""

    exit_status = 2


class GeometryError(ZlocusError):
    """Cameras, area and heights that do not fit together (no overlap, no intersection)."""

    exit_status = 2


class OutputError(ZlocusError):
    """An output that cannot be written."""

    exit_status = 2


class CoverageError(ZlocusError):
    """Too little was matched to call the run a success; what is done is kept."""

    exit_status = 3


class StoppedError(ZlocusError):
    """A run that ended before its surface was whole; what is done is kept."""

    exit_status = 3


class TileError(ZlocusError):
    """A part of an image that failed for no reason the input explains."""


class ZlocusWarning(UserWarning):
    """Something the user should know, that does not stop the run."""
