"""SIGINT (Ctrl-C), SIGTERM and SIGHUP end a command in the same way: it stops, keeps finished work, and says so.

Only the command line asks for this (`handle_signals`). In a process of somebody else, such as a notebook, signals do
what they did before.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from types import FrameType
from typing import Any, NoReturn, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
# The signals that end a command, as far as the system has them.
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
# Time that a command has to clean up after a signal; another signal after that time ends it at once.
TIDYING_S = 5.0
AGAIN_S = 0.05
STDERR = 2


class Ended(KeyboardInterrupt):
    """Raised when a signal ends the command, and handled like Ctrl-C. number : of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@dataclass
class _Command:
    """State of the signal handlers.

    is_running : a command is between its first and its last line; ended : exception by which it was ended, since
    `since_s` on the monotonic clock.
    """

    is_running: bool = False
    ended: Ended | None = None
    since_s: float = 0.0


_command = _Command()


def handle_signals() -> None:
    """Let signals end the command of this process.

    Signals that were ignored at its start stay ignored, such as SIGHUP below nohup.
    """
    if threading.current_thread() is not threading.main_thread():
        return  # where Python lets nobody set them
    for number in ENDING:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _on_signal)
    # The function that is registered first is called last.
    atexit.register(_ignore_signals)
    show = sys.unraisablehook

    def show_unraisable(unraisable: Any) -> None:
        """Show an exception that no code can catch; a signal among them is sent again instead."""
        if isinstance(unraisable.exc_value, Ended):
            threading.Thread(target=_again, args=(unraisable.exc_value.number,), daemon=True).start()
        else:
            show(unraisable)

    sys.unraisablehook = show_unraisable


def ended_by_signals(command: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Run a command in which signals raise `Ended`.

    Any other exception after a signal is a consequence of it, such as an error of a terminal that has gone, and is
    replaced by that `Ended`.
    """
    try:
        _command.is_running = True
        return command(*args, **kwargs)
    except BaseException as error:
        if _command.ended is not None and error is not _command.ended:
            raise _command.ended from error
        raise
    finally:
        _command.is_running = False


def exit_status(number: int) -> int:
    """Exit status of a command that a signal ended, as shells count it: 130, 143 or 129."""
    return 128 + number


def sentence_of(number: int) -> str:
    """The sentence that a command prints when a signal has ended it."""
    return "Interrupted." if number == signal.SIGINT else f"Ended by {signal.Signals(number).name}."


def leave(status: int) -> NoReturn:
    """End this process without waiting for its threads, after removing what would outlive it."""
    end_children()
    jit = sys.modules.get("zlocus.core.jit")
    if jit is not None:
        jit.CACHE.remove_temporary()
    with suppress(Exception):  # where they were being written, or have gone
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def end_children() -> None:
    """Kill the child processes: workers, and the process that starts them. A browser has its own session and stays."""
    if not hasattr(os, "getsid"):
        return
    import psutil

    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error, OSError):  # gone meanwhile
            if os.getsid(child.pid) == os.getsid(0):
                child.kill()


def _on_signal(number: int, frame: FrameType | None) -> None:
    """Raise `Ended` inside a command; outside of it, or where it cleans up for too long, end the process."""
    ended, is_running = _command.ended, _command.is_running
    if ended is None:
        ended = _command.ended = Ended(number)
        _command.since_s = time.monotonic()
        if is_running:
            raise ended
        _say_ended(ended)
    elif time.monotonic() - _command.since_s > TIDYING_S:
        if is_running:  # else it is said
            _say_ended(ended)
    elif is_running and not _is_handled(ended):
        raise ended  # it was swallowed
    else:
        return  # it is on its way out
    leave(exit_status(ended.number))


def _say_ended(ended: Ended) -> None:
    with suppress(OSError):
        # Not through sys.stderr, which may be in the middle of a line.
        os.write(STDERR, f"zlocus: {sentence_of(ended.number)}\n".encode())


def _ignore_signals() -> None:
    """Ignore further signals: the work is done, and Python is about to remove the handlers."""
    for number in ENDING:
        if signal.getsignal(number) is _on_signal:
            signal.signal(number, signal.SIG_IGN)


def _is_handled(ended: Ended) -> bool:
    """Whether a block that handles an exception runs now; if not, the exception was lost."""
    error = sys.exc_info()[1]
    while error is not None and error is not ended:
        error = error.__context__
    return error is not None


def _again(number: int) -> None:
    """Send this process a signal again after the code that could not raise it has ended."""
    time.sleep(AGAIN_S)
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)  # wakes it too
    else:
        import _thread

        _thread.interrupt_main(signal.Signals(number))
