"""Workers in local processes, each with one task at a time. When one dies, only its task fails; another replaces it."""

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
from zlocus.core.startup import reuse_memory
from zlocus.pipeline.execution.tasks import Cause, Failure, Outcome, attempted

# Each worker uses one core. Without these variables the libraries in n workers would start n times as many threads.
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "GDAL_NUM_THREADS"), "1")
# Modules imported once, by the process that workers are forked from.
PRELOADED = ("zlocus.pipeline.execution.preload",)
TIME_TO_STOP_S = 2.0
# A signal to all processes of a run reaches the main process at most this much later than a worker.
SIGNALS_SPREAD_S = 0.3


@dataclass
class _Worker:
    process: BaseProcess
    connection: Connection
    task: Any = None


class Processes:
    """Workers in processes of their own.

    They are forked from an idle process that has imported everything; where the system cannot fork they are started
    anew. They are never forked from the main process, whose threads and open rasters must not be shared. Leaving the
    context stops all.

    >>> with Processes(function, 2) as workers:
    ...     outcomes = run_tasks(workers, tasks)

    function : sent to each process once; it must be picklable.
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
        # `wait` finds a worker that has died in the meantime.
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
        """Stop all workers at once."""
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
        own_end, worker_end = self._context.Pipe()
        name = f"worker {self._number}"
        process = self._context.Process(target=work, args=(worker_end, self._function, name), name=name, daemon=True)
        with _environment_below(ONE_THREAD | kernel_cache()), _without_main(), _signals_blocked_below():
            process.start()
        worker_end.close()
        return _Worker(process, own_end)

    def __enter__(self) -> Processes:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def kernel_cache() -> dict[str, str]:
    """Environment variables with which workers use the temporary kernel cache of this process, if it has one."""
    return {} if CACHE.temporary is None else {"NUMBA_CACHE_DIR": str(CACHE.temporary)}


@contextmanager
def _environment_below(variables: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the processes that are started inside the block."""
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
def _signals_blocked_below() -> Iterator[None]:
    """Block the signals that end a run in processes started inside the block, until these unblock them.

    Ctrl-C reaches the whole process group, and a process that is still importing modules would print a trace.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # The resource tracker unblocks signals when it starts; started now, it does not do so inside the block.
    ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main() -> Iterator[None]:
    """Keep processes started inside the block from importing the main script, which would start the run again."""
    main = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main


def work(connection: Connection, function: bytes, name: str) -> None:
    """Work on tasks until the connection is closed; the main function of a worker process."""
    _set_signals()
    one_thread()
    reuse_memory()
    call = pickle.loads(function)
    cpu_s = 0.0  # the CPU time of the start is counted with the first task
    # The main process, and with it the connection, may end at any time.
    with suppress(EOFError, OSError):
        while True:
            outcome = attempted(call, connection.recv(), name, cpu_s)
            cpu_s += outcome.cpu_s
            connection.send(outcome)


def _set_signals() -> None:
    """End this process when the main process ends, or by a signal to this process alone."""
    # Ctrl-C reaches the whole process group; the main process decides what happens.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDING)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_exit_with, args=(parent,), daemon=True).start()


def _exit_with(parent: BaseProcess) -> None:
    """End this process as soon as another process has ended for any reason."""
    parent.join()
    os._exit(1)


def one_thread() -> None:
    """Limit those libraries of this process to one thread that no environment variable limits."""
    import cv2

    cv2.setNumThreads(1)


def _lost(process: BaseProcess) -> Failure:
    """Why a process ended, as a failure of its task."""
    process.join(TIME_TO_STOP_S)
    status = process.exitcode
    if status == -signal.SIGKILL:
        return Failure(
            Cause.LOST, f"its process was killed (signal {-status}), as the system does when memory runs out"
        )
    if status is not None and status < 0:
        if -status in ENDING:
            time.sleep(SIGNALS_SPREAD_S)  # where the signal was meant for all, this process ends here
        return Failure(Cause.LOST, f"its process ended by signal {-status}")
    return Failure(Cause.LOST, f"its process ended with status {status}")
