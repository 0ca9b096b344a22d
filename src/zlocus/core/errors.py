"""The errors of zlocus: every message says what happened, where, and what to do next."""

from __future__ import annotations


class ZlocusError(Exception):
    """An error that one sentence explains. `exit_status` : status with which the command line ends."""

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
    """Too little was matched to call the run a success; the results are kept."""

    exit_status = 3


class StoppedError(ZlocusError):
    """A run that stopped before its surface was complete; finished tiles are kept."""

    exit_status = 3


class TileError(ZlocusError):
    """A tile of an image that failed for a reason that the input does not explain."""


class ZlocusWarning(UserWarning):
    """A fact that the user should know and that does not stop the run."""


class ZlocusNote(ZlocusWarning):
    """A fact that the user may like to know, and that makes no result worse."""
