"""How a command ends: whatever goes wrong becomes one sentence on stderr and an exit status."""

from __future__ import annotations

import functools
import logging
import shutil
import signal
import sys
import textwrap
import traceback
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

import typer

from zlocus.cli.console import Console
from zlocus.core.errors import ZlocusError, ZlocusNote, ZlocusWarning
from zlocus.core.parallel import is_busy
from zlocus.core.signals import Ended, end_children, ended_by_signals, exit_status, leave, sentence_of

EXIT_OWN_FAULT = 1
LOGGER = logging.getLogger("zlocus")
P = ParamSpec("P")
R = TypeVar("R")


@dataclass
class _ShownWarnings:
    """Which of our warnings are printed. with_notes : also those that make no result worse."""

    with_notes: bool = True


SHOWN_WARNINGS = _ShownWarnings()


def explained(command: Callable[P, R], console: Console | None = None) -> Callable[P, R]:
    """A command whose errors become one sentence on stderr and an exit status.

    console : of the command, which gets each error too; where it is verbose, the trace is printed.
    """

    @functools.wraps(command)
    def run(*args: P.args, **kwargs: P.kwargs) -> R:
        SHOWN_WARNINGS.with_notes = console is None or not console.is_quiet
        try:
            return ended_by_signals(command, *args, **kwargs)
        except ZlocusError as error:
            raise _failed(str(error), error.exit_status, console) from error
        except KeyboardInterrupt as error:
            raise _interrupted(error, console) from error
        except (typer.Exit, BrokenPipeError):
            raise
        except Exception as error:
            what = f"{type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
            advice = "This is a fault of zlocus, not of the input; see the trace with --verbose, and report it."
            raise _failed(f"Unexpected {what}. {advice}", EXIT_OWN_FAULT, console) from error

    return run


def _failed(sentence: str, status: int, console: Console | None, has_trace: bool = True) -> typer.Exit:
    """Say why a command ends. has_trace : whether the trace of the current exception tells more than the sentence."""
    if has_trace and console is not None and console.is_verbose:
        traceback.print_exc()
    _say(f"zlocus: {sentence}")
    if console is not None:
        console.failed(sentence, status, has_trace)
    return typer.Exit(status)


def _interrupted(error: KeyboardInterrupt, console: Console | None) -> typer.Exit:
    """What a command ends with after a signal. Its processes are killed, and its threads are not waited for: nothing is
    half-written then, for threads only compute."""
    number = error.number if isinstance(error, Ended) else int(signal.SIGINT)
    if isinstance(error, Ended):
        end_children()
    try:
        failed = _failed(sentence_of(number), exit_status(number), console, has_trace=False)
    except OSError:  # the terminal has gone
        leave(exit_status(number))
    if is_busy():
        leave(exit_status(number))
    return failed


def _say(sentence: str) -> None:
    """To stderr, broken between words on a terminal, on one line elsewhere."""
    if sys.stderr.isatty():
        width = shutil.get_terminal_size().columns
        sentence = textwrap.fill(sentence, width, break_long_words=False, break_on_hyphens=False)
    print(sentence, file=sys.stderr)


def show_our_warnings() -> None:
    """Show our own warnings as sentences from here on, those of libraries as they are."""
    show: Callable[..., Any] = warnings.showwarning

    def show_warning(message: Warning | str, category: type[Warning], *args: Any, **kwargs: Any) -> None:
        if issubclass(category, ZlocusWarning):
            if SHOWN_WARNINGS.with_notes or not issubclass(category, ZlocusNote):
                _say(f"zlocus: {message}")
            if LOGGER.hasHandlers():
                LOGGER.warning("zlocus: %s", message)
        else:
            show(message, category, *args, **kwargs)

    warnings.showwarning = show_warning
