"""What a command says: progress on standard error, its answer on standard output, and all of it in a log file."""

from __future__ import annotations

import json
import platform
import sys
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from zlocus import __version__
from zlocus.cli.answer import Answer
from zlocus.core.errors import ConfigError, OutputError
from zlocus.core.progress import KeptNotes, ManifoldProgress, Progress, SilentProgress, progress_for

if TYPE_CHECKING:
    import logging

GROUP = "Messages"
# Distributions whose versions --verbose and --log state.
LIBRARIES = ("numpy", "numba", "scipy", "rasterio", "pyproj", "opencv-python-headless")


@dataclass(frozen=True)
class OutputOptions:
    """The options that every command has: how much it says, and where."""

    quiet: Annotated[
        bool,
        typer.Option(
            "-q", "--quiet", help="Print errors, warnings and tables only, no progress.", rich_help_panel=GROUP
        ),
    ] = False
    verbose: Annotated[
        bool,
        typer.Option(
            "-v", "--verbose", help="Also print versions, details of every stage, and traces of errors.",
            rich_help_panel=GROUP,
        ),
    ] = False  # fmt: skip
    log: Annotated[
        Path | None,
        typer.Option(
            help="Append everything that is said to a file, with times and details.", metavar="FILE",
            rich_help_panel=GROUP,
        ),
    ] = None  # fmt: skip
    as_json: Annotated[
        bool,
        typer.Option("--json", help="Print one JSON object on standard output.", rich_help_panel=GROUP),
    ] = False


class Console:
    """Says what a command tells its user.

    progress : of the command; is_verbose : whether traces of errors are printed; is_quiet : whether only warnings and
    errors are said; notes : sentences that were said on
    the way, warnings among them, kept where --json prints them.
    """

    def __init__(self, command: str, options: OutputOptions | None = None, given: dict[str, Any] | None = None) -> None:
        """A console for a command. given : values that stand in each JSON object, such as the output folder.

        Raises
        ------
        ConfigError
            Options that exclude each other.
        OutputError
            The log file cannot be written.
        """
        self._command, self._options, self._given = command, options or OutputOptions(), given or {}
        self._log: logging.Logger | None = None
        self._warnings: logging.Handler | None = None
        self.is_verbose, self.is_quiet = self._options.verbose, self._options.quiet
        if self.is_quiet and self.is_verbose:
            raise ConfigError("--quiet and --verbose exclude each other. Leave one out.")
        self.progress: Progress = SilentProgress() if self.is_quiet else progress_for(sys.stderr)
        self.notes: list[str] = []
        if self._options.log is not None or self.is_verbose:
            self._open_log()
        if self._options.as_json:
            from zlocus.cli.log import KeptWarnings

            self.progress = ManifoldProgress((self.progress, KeptNotes(self.notes)))
            self._warnings = KeptWarnings(self.notes)

    def _open_log(self) -> None:
        """Send everything that is said to the log file, and details to the terminal where they are wanted."""
        from zlocus.cli.log import log_of_command

        try:
            self._log, progress = log_of_command(self._options.log, self.progress if self.is_verbose else None)
        except OSError as error:
            raise OutputError(
                f"The log {self._options.log} cannot be written: {error.strerror}. Choose another file with --log."
            ) from error
        self.progress = ManifoldProgress((self.progress, progress))
        self._log.debug("zlocus %s: %s", __version__, " ".join(sys.argv))
        self._log.debug("%s, Python %s, %s", platform.platform(), platform.python_version(), _versions())

    def close(self) -> None:
        """End the log, and keep no more warnings."""
        if self._warnings is not None:
            self._warnings.close()
        if self._log is not None:
            from zlocus.cli.log import close_log

            close_log(self._log)

    def answer(self, answer: Answer) -> None:
        """Print what the command answers, as text or as JSON."""
        if self._log is not None:
            self._log.info(answer.text)
        if self._options.as_json:
            self._print_object(answer.exit_status, answer.values)
        elif answer.is_asked_for or not self._options.quiet:
            print(answer.text)

    def failed(self, sentence: str, status: int, has_trace: bool = True) -> None:
        """Print why the command fails, as the only object with --json. has_trace : of the current exception."""
        if self._log is not None:
            self._log.error("zlocus: %s", sentence)
            if has_trace:
                self._log.debug("%s", traceback.format_exc().rstrip())
        if self._options.as_json:
            self._print_object(status, {"error": sentence})

    def _print_object(self, status: int, values: Any) -> None:
        """Print one JSON object. values : entries besides those that every command has."""
        record = {"command": self._command, "version": __version__, "exit_status": status, **self._given, **values}
        print(json.dumps(record, indent=2, default=str), flush=True)


def _versions() -> str:
    """Versions of the libraries that results may depend on."""
    from importlib.metadata import PackageNotFoundError, version

    found = []
    for name in LIBRARIES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:  # another distribution of the same library
            found.append(f"{name} unknown")
    return ", ".join(found)
