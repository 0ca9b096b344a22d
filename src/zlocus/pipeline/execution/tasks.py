"""Run tasks on workers of any kind. Tasks that failed for a reason that may pass are tried again; a failure stops no
other task."""

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

# Attempts at a task whose failure may pass.
MAX_ATTEMPTS = 3


class Cause(StrEnum):
    """Why a task has no result."""

    LOST = "worker lost"
    MEMORY = "out of memory"
    INPUT = "input"
    FAULT = "fault"


@dataclass(frozen=True)
class Failure:
    """Why an attempt at a task failed.

    reason : what happened, as a clause without a full stop; trace : Python's trace, for our own faults; error : the
    exception, where its message is complete; is_given_up : whether the workers had tried the task several times
    themselves, beside other tasks that may have been the cause.
    """

    cause: Cause
    reason: str
    trace: str = ""
    error: ZlocusError | None = None
    is_given_up: bool = False

    @property
    def may_pass(self) -> bool:
        """Whether another attempt may succeed."""
        return self.cause is not Cause.FAULT


@dataclass(frozen=True)
class Outcome:
    """Result of one attempt at a task.

    result : None after a failure; failure : None with a result; wall_s, cpu_s : time of the attempt; peak_mb : largest
    memory that its worker has held so far; worker : name of the worker; attempt : number, from 1; is_final : whether no
    other attempt follows.
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
    """What runs tasks: this process, other processes, or a cluster."""

    @property
    def slots(self) -> int:
        """Number of tasks that may run at a time, 1 or more; it may change."""
        ...

    def submit(self, task: Any) -> None:
        """Start a task. Callers never start more than `slots` tasks at a time."""
        ...

    def wait(self) -> list[Outcome]:
        """Wait until at least one started task has ended; return the outcomes of all that have."""
        ...


def run_tasks(workers: Workers, tasks: Iterable[Any]) -> Iterator[Outcome]:
    """Outcomes of all attempts, in the order in which they end; each task has one final outcome.

    A task that failed for a reason that may pass is tried again after all others, alone, so that all memory is free for
    it. It is tried `MAX_ATTEMPTS` times in all; only once more where the workers had already tried it several times.
    tasks : hashable.
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
                attempts[outcome.task] = max(attempts[outcome.task], MAX_ATTEMPTS - 1)
            n = attempts[outcome.task]
            is_final = outcome.failure is None or not outcome.failure.may_pass or n == MAX_ATTEMPTS
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
    """Try a task once in this process.

    cpu_before_s : reading of `clock` from which CPU time is counted.
    """
    wall = time.perf_counter()
    result, failure = None, None
    try:
        result = function(task)
    except Exception as error:
        failure = failure_of(error)
    wall_s, cpu_s = time.perf_counter() - wall, clock() - cpu_before_s
    return Outcome(task, result, failure, wall_s, cpu_s, peak_memory_mb(), worker)


def failure_of(error: Exception) -> Failure:
    """The failure that an exception means."""
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
    """This process as a worker, with one task at a time.

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
