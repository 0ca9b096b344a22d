"""Run a function over tasks in threads of this process. Kernels, GDAL and OpenCV release the interpreter lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")
# Calls that threads are working on.
_running: set[Future[Any]] = set()


def run_all(function: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Iterator[tuple[Task, Result]]:
    """Pairs of task and result in the order in which the tasks end, with at most `workers` tasks at a time.

    An exception in a task, or an interrupt, ends the run: tasks that have not started are dropped. After an interrupt,
    running tasks are not waited for, see `is_busy`.
    """
    remaining = iter(tasks)
    if workers == 1:
        for task in remaining:
            yield task, function(task)
        return
    pool = ThreadPoolExecutor(workers)
    running: dict[Future[Result], Task] = {}

    def start(task: Task) -> None:
        running[submitted(pool, function, task)] = task

    try:
        for task in islice(remaining, workers):
            start(task)
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                result = future.result()
                for following in islice(remaining, 1):
                    start(following)
                yield task, result
    except KeyboardInterrupt:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    except BaseException:
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown()


def submitted(pool: ThreadPoolExecutor, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
    """Submit a call to a thread pool, so that `is_busy` counts it."""
    future = pool.submit(function, *arguments)
    _running.add(future)
    future.add_done_callback(_running.discard)
    return future


@contextmanager
def busy() -> Iterator[None]:
    """Count the block, which runs in a thread of another library, in `is_busy`."""
    call: Future[Any] = Future()
    _running.add(call)
    try:
        yield
    finally:
        _running.discard(call)


def is_busy() -> bool:
    """Whether threads are still working, as after an interrupt; the process would wait for them at its end."""
    return bool(_running)
