"""Local processes, one task at a time each: one that dies costs its task only, and another takes its place."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.resource_tracker import ensure_running
from types import ModuleType, TracebackType
from typing import Any

from zlocus.core.jit import CACHE
from zlocus.core.signals import ENDING
from zlocus.pipeline.execution.tasks import Cause, Failure, Outcome, attempted

# Kernels use one core each, and so must the libraries below them: else n workers have n times the threads.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "GDAL_NUM_THREADS"), "1")
# Imported once, by the process that workers are forked from.
PRELOADED = ("zlocus.pipeline.execution.preload",)
TIME_TO_STOP_S = 2.0
# Signals to all processes of a run reach this one soon after they reach a worker.
SIGNALS_SPREAD_S = 0.3


@dataclass
class _Worker:
    process: BaseProcess
    connection: Connection
    task: Any = None


class Processes:
    """Workers in processes of their own.

    Processes are forked from one that has imported everything and does nothing (started anew where the system cannot
    do that), never from this one, whose threads and open rasters must not be shared. Leaving the context stops all.

    >>> with Processes(function, 2) as workers:
    ...     outcomes = run_tasks(workers, tasks)

    function : and what it holds must pickle; it reaches each process once.
    """

    def __init__(self, function: Callable[[Any], Any], slots: int) -> None:
        self.slots = slots
        self._function = pickle.dumps(function)
        methods = multiprocessing.get_all_start_methods()
        self._context: Any = multiprocessing.get_context("forkserver" if "forkserver" in methods else "spawn")
        if "forkserver" in methods:
            self._context.set_forkserver_preload(list(PRELOADED))
        self._idle: list[_Worker] = []
        self._busy: list[_Worker] = []
        self._number = 0

    def submit(self, task: Any) -> None:
        """See `Workers`."""
        worker = self._idle.pop() if self._idle else self._started()
        worker.task = task
        self._busy.append(worker)
        # One that has died meanwhile is found by `wait`.
        with suppress(OSError):
            worker.connection.send(task)

    def wait(self) -> list[Outcome]:
        """See `Workers`."""
        ready = wait([worker.connection for worker in self._busy])
        outcomes = []
        for worker in [worker for worker in self._busy if worker.connection in ready]:
            self._busy.remove(worker)
            try:
                outcome: Outcome = worker.connection.recv()
                self._idle.append(worker)
            except (EOFError, OSError, pickle.UnpicklingError):
                outcome = Outcome(worker.task, failure=_lost(worker.process), worker=worker.process.name)
                worker.connection.close()
            outcomes.append(outcome)
        return outcomes

    def close(self) -> None:
        """Stop all, whatever they do."""
        workers = self._idle + self._busy
        self._idle, self._busy = [], []
        for worker in workers:
            worker.connection.close()
            worker.process.terminate()
        for worker in workers:
            worker.process.join(TIME_TO_STOP_S)
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()

    def _started(self) -> _Worker:
        self._number += 1
        mine, theirs = self._context.Pipe()
        name = f"worker {self._number}"
        process = self._context.Process(target=work, args=(theirs, self._function, name), name=name, daemon=True)
        with _environment_below(ONE_THREAD | kernel_cache()), _without_main(), _deaf_below():
            process.start()
        theirs.close()
        return _Worker(process, mine)

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def kernel_cache() -> dict[str, str]:
    """Variables for the environment of processes that this one starts: they keep kernels where it does, if that is a
    folder of its own."""
    return {} if CACHE.temporary is None else {"NUMBA_CACHE_DIR": str(CACHE.temporary)}


@contextmanager
def _environment_below(variables: dict[str, str]) -> Iterator[None]:
    """Processes that are started meanwhile find these variables in their environment."""
    kept = {key: os.environ.get(key) for key in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for key, value in kept.items():
            if value is None:
                del os.environ[key]
            else:
                os.environ[key] = value


@contextmanager
def _deaf_below() -> Iterator[None]:
    """Processes that are started meanwhile do not hear the signals that end a run, until they ask for them: of Ctrl-C
    the whole group hears, and one that is still importing would print where it was."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # It lets signals through when it is started, as the first process would make it.
    ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main() -> Iterator[None]:
    """Processes that are started meanwhile do not run the script that runs here, which would begin all this again."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def work(connection: Connection, function: bytes, name: str) -> None:
    """What a process does: tasks, until its other end is closed."""
    _mind_signals()
    one_thread()
    call = pickle.loads(function)
    cpu_s = 0.0  # what it took to start counts too
    # The other end may be gone, with its process, at any time.
    with suppress(EOFError, OSError):
        while True:
            outcome = attempted(call, connection.recv(), name, cpu_s)
            cpu_s += outcome.cpu_s
            connection.send(outcome)


def _mind_signals() -> None:
    """Let this process end with the one that waits for its results, and when it is told to by itself."""
    # Of Ctrl-C the whole group hears; who waits for the results decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_leave_after, args=(parent,), daemon=True).start()


def _leave_after(parent: BaseProcess) -> None:
    """End this process when another has ended, however that was."""
    parent.join()
    os._exit(1)


def one_thread() -> None:
    """Keep libraries of this process to one thread, as far as the environment cannot."""
    import cv2

    cv2.setNumThreads(1)


def _lost(process: BaseProcess) -> Failure:
    """What is known of a process that has gone."""
    process.join(TIME_TO_STOP_S)
    status = process.exitcode
    if status == -signal.SIGKILL:
        return Failure(
            Cause.LOST, f"its process was killed (signal {-status}), as the system does when memory runs out"
        )
    if status is not None and status < 0:
        if -status in ENDING:
            time.sleep(SIGNALS_SPREAD_S)  # if it was not meant for the worker alone, this process ends here
        return Failure(Cause.LOST, f"its process ended by signal {-status}")
    return Failure(Cause.LOST, f"its process ended with status {status}")
