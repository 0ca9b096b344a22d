"""SIGINT (Ctrl-C), SIGTERM and SIGHUP end a command alike: its work stops, what is done is kept, one sentence says so.

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
# What ends a command, where the system has it.
ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
# A command that was told to end has so long to tidy up; the next signal after that ends it at once.
TIDYING_S = 5.0
AGAIN_S = 0.05
STDERR = 2


class Ended(KeyboardInterrupt):
    """A signal that ends the command. Whatever handles Ctrl-C handles this. number : of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@dataclass
class _Command:
    """What the handlers know. is_running : between the first and the last line of a command; ended : by this, since
    since_s on the monotonic clock."""

    is_running: bool = False
    ended: Ended | None = None
    since_s: float = 0.0


_command = _Command()


def handle_signals() -> None:
    """Let signals end the command of this process. Those that were ignored when it began, as SIGHUP is below nohup,
    stay ignored."""
    if threading.current_thread() is not threading.main_thread():
        return  # where Python lets nobody set them
    for number in ENDING:
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, _on_signal)
    # The first to be registered is the last to be called.
    atexit.register(_ignore_signals)
    show = sys.unraisablehook

    def show_unraisable(unraisable: Any) -> None:
        """An exception that nobody can catch is shown, unless it is a signal, which then comes again."""
        if isinstance(unraisable.exc_value, Ended):
            threading.Thread(target=_again, args=(unraisable.exc_value.number,), daemon=True).start()
        else:
            show(unraisable)

    sys.unraisablehook = show_unraisable


def ended_by_signals(command: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
    """Result of a command, in which signals raise `Ended`. Whatever else comes out of it after a signal was a
    consequence, such as an error of a terminal that has gone, and becomes that `Ended`."""
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
    """Exit status of a command that a signal ended, as shells count: 130, 143 and 129."""
    return 128 + number


def sentence_of(number: int) -> str:
    """What a command says that a signal ended."""
    return "Interrupted." if number == signal.SIGINT else f"Ended by {signal.Signals(number).name}."


def leave(status: int) -> NoReturn:
    """End this process without waiting for its threads, once what would outlive it is gone."""
    end_children()
    jit = sys.modules.get("zlocus.core.jit")
    if jit is not None:
        jit.CACHE.remove_temporary()
    with suppress(Exception):  # where they were being written, or have gone
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def end_children() -> None:
    """Kill the processes below this one: workers, and what starts them. A browser has a session of its own."""
    if not hasattr(os, "getsid"):
        return
    import psutil

    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.Error, OSError):  # gone meanwhile
            if os.getsid(child.pid) == os.getsid(0):
                child.kill()


def _on_signal(number: int, frame: FrameType | None) -> None:
    """Raise `Ended` in the command; before and after it, and where it tidies up for too long, end the process."""
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
        # Not by sys.stderr, which may be in the middle of a sentence.
        os.write(STDERR, f"zlocus: {sentence_of(ended.number)}\n".encode())


def _ignore_signals() -> None:
    """Let signals change nothing any more: all is done, and Python is about to drop the handlers."""
    for number in ENDING:
        if signal.getsignal(number) is _on_signal:
            signal.signal(number, signal.SIG_IGN)


def _is_handled(ended: Ended) -> bool:
    """Whether a block that tidies up after an exception is what runs now; if not, the exception was swallowed."""
    error = sys.exc_info()[1]
    while error is not None and error is not ended:
        error = error.__context__
    return error is not None


def _again(number: int) -> None:
    """Send this process a signal once more, when the code that could not raise it has ended."""
    time.sleep(AGAIN_S)
    main = threading.main_thread().ident
    if hasattr(signal, "pthread_kill") and main is not None:
        signal.pthread_kill(main, number)  # wakes it too
    else:
        import _thread

        _thread.interrupt_main(signal.Signals(number))
