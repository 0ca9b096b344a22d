"""Runs a function over tasks in threads of this process; kernels, GDAL and OpenCV release the interpreter lock."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")
# What threads are working on.
_running: set[Future[Any]] = set()


def run_all(function: Callable[[Task], Result], tasks: Iterable[Task], workers: int) -> Iterator[tuple[Task, Result]]:
    """Results as they come, at most `workers` tasks at a time and no result waiting while tasks pile up.

    An exception in a task, or an interrupt, ends the run: tasks not begun are dropped; after an interrupt those that
    run are not waited for, see `is_busy`.
    """
    remaining = iter(tasks)
    if workers == 1:
        for task in remaining:
            yield task, function(task)
        return
    pool = ThreadPoolExecutor(workers)
    running: dict[Future[Result], Task] = {}

    def begin(task: Task) -> None:
        running[submitted(pool, function, task)] = task

    try:
        for task in islice(remaining, workers):
            begin(task)
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                result = future.result()
                for following in islice(remaining, 1):
                    begin(following)
                yield task, result
    except KeyboardInterrupt:
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    except BaseException:
        pool.shutdown(wait=True, cancel_futures=True)
        raise
    pool.shutdown()


def submitted(pool: ThreadPoolExecutor, function: Callable[..., Result], *arguments: Any) -> Future[Result]:
    """A call that a pool is to make, which `is_busy` knows of."""
    future = pool.submit(function, *arguments)
    _running.add(future)
    future.add_done_callback(_running.discard)
    return future


@contextmanager
def busy() -> Iterator[None]:
    """A call of a thread of somebody else's, which `is_busy` knows of meanwhile."""
    call: Future[Any] = Future()
    _running.add(call)
    try:
        yield
    finally:
        _running.discard(call)


def is_busy() -> bool:
    """Whether threads are at work, as after an interrupt: the process would wait for them at its end."""
    return bool(_running)
