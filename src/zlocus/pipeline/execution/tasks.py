"""Runs tasks wherever there are workers: what may fail for a passing reason is tried again, what fails for good is
told, and all others are done."""

from __future__ import annotations

import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Any, Protocol

from zlocus.core.errors import InputError, ZlocusError
from zlocus.core.resources import peak_memory_mb

ATTEMPTS = 3


class Cause(StrEnum):
    """Why a task has no result."""

    LOST = "worker lost"
    MEMORY = "out of memory"
    INPUT = "input"
    FAULT = "fault"


@dataclass(frozen=True)
class Failure:
    """cause; reason : what happened, as a clause without its full stop; trace : of our own faults; error : where it
    says all that there is to say; is_given_up : by workers that had tried again themselves, beside other tasks,
    one of which may have been the culprit."""

    cause: Cause
    reason: str
    trace: str = ""
    error: ZlocusError | None = None
    is_given_up: bool = False

    @property
    def may_pass(self) -> bool:
        """Whether another attempt may end otherwise."""
        return self.cause is not Cause.FAULT


@dataclass(frozen=True)
class Outcome:
    """What became of one attempt at a task.

    result : None after a failure. failure : None with a result. wall_s, cpu_s : of the attempt; peak_mb : most memory
    that its worker has held so far; worker : that did it. attempt : 1 is the first. is_final : no other follows.
    """

    task: Any
    result: Any = None
    failure: Failure | None = None
    wall_s: float = 0.0
    cpu_s: float = 0.0
    peak_mb: float = 0.0
    worker: str = ""
    attempt: int = 1
    is_final: bool = True


class Workers(Protocol):
    """Where tasks are done."""

    @property
    def slots(self) -> int:
        """Tasks that it takes at a time, 1 or more; may change."""
        ...

    def submit(self, task: Any) -> None:
        """Begin a task; never more than `slots` at a time."""
        ...

    def wait(self) -> list[Outcome]:
        """Outcomes of one task or more that were begun, as soon as there is one."""
        ...


def run_tasks(workers: Workers, tasks: Iterable[Any]) -> Iterator[Outcome]:
    """Outcomes as they come, of failed attempts too; each task has one final outcome.

    A task that failed for a reason that may pass is tried again when all others are done, by itself, so that it has all
    the memory; `ATTEMPTS` times in all, once more where workers had tried it again already. tasks : hashable.
    """
    waiting, again = deque(tasks), deque[Any]()
    attempts: Counter[Any] = Counter()
    n_running = 0
    while waiting or again or n_running:
        while waiting and n_running < workers.slots:
            workers.submit(waiting.popleft())
            n_running += 1
        if not n_running:
            workers.submit(again.popleft())
            n_running = 1
        for outcome in workers.wait():
            n_running -= 1
            attempts[outcome.task] += 1
            if outcome.failure is not None and outcome.failure.is_given_up:
                attempts[outcome.task] = max(attempts[outcome.task], ATTEMPTS - 1)
            n = attempts[outcome.task]
            is_final = outcome.failure is None or not outcome.failure.may_pass or n == ATTEMPTS
            if not is_final:
                again.append(outcome.task)
            yield replace(outcome, attempt=n, is_final=is_final)


def attempted(
    function: Callable[[Any], Any],
    task: Any,
    worker: str,
    cpu_before_s: float,
    clock: Callable[[], float] = time.process_time,
) -> Outcome:
    """One attempt at a task, in this process. cpu_before_s : from when on CPU time counts, by a clock of it."""
    wall = time.perf_counter()
    result, failure = None, None
    try:
        result = function(task)
    except Exception as error:
        failure = failure_of(error)
    wall_s, cpu_s = time.perf_counter() - wall, clock() - cpu_before_s
    return Outcome(task, result, failure, wall_s, cpu_s, peak_memory_mb(), worker)


def failure_of(error: Exception) -> Failure:
    """An exception as a failure."""
    words = " ".join(str(error).split()).rstrip(".")
    if isinstance(error, MemoryError):
        return Failure(Cause.MEMORY, "it does not fit into memory")
    if isinstance(error, InputError):
        return Failure(Cause.INPUT, words, error=error)
    if isinstance(error, OSError):
        return Failure(Cause.INPUT, f"{type(error).__name__}: {words}")
    if isinstance(error, ZlocusError):
        return Failure(Cause.FAULT, words, error=error)
    trace = "".join(traceback.format_exception(error))
    return Failure(Cause.FAULT, f"{type(error).__name__}: {words}".rstrip(": "), trace)


class Here:
    """This very process, one task at a time.

    >>> outcomes = run_tasks(Here(function), tasks)
    """

    slots = 1

    def __init__(self, function: Callable[[Any], Any]) -> None:
        self._function = function
        self._tasks: list[Any] = []

    def submit(self, task: Any) -> None:
        """See `Workers`."""
        self._tasks.append(task)

    def wait(self) -> list[Outcome]:
        """See `Workers`."""
        return [attempted(self._function, self._tasks.pop(), "this process", time.process_time())]
