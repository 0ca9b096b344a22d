from __future__ import annotations

import threading
import time

import pytest

from zlocus.core.parallel import is_busy, run_all

SOON_S = 5.0


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_every_task_once_with_its_result(workers):
    done = list(run_all(lambda x: x * x, range(23), workers))
    assert sorted(done) == [(x, x * x) for x in range(23)]


def test_one_worker_keeps_the_order():
    assert [task for task, _ in run_all(str, [3, 1, 2], 1)] == [3, 1, 2]


@pytest.mark.parametrize("workers", [1, 3])
def test_no_more_tasks_at_a_time_than_workers(workers):
    lock, now, most = threading.Lock(), 0, 0

    def work(_):
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.01)
        with lock:
            now -= 1

    list(run_all(work, range(12), workers))
    assert most == workers


@pytest.mark.parametrize("workers", [1, 2])
def test_results_do_not_pile_up(workers):
    """A consumer that stops after one result has begun few tasks."""
    begun = []
    results = run_all(begun.append, range(100), workers)
    next(results)
    results.close()
    assert len(begun) <= workers + 2


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_an_exception_ends_the_run(workers, error):
    begun = []

    def work(x):
        begun.append(x)
        if x == 3:
            raise error(x)

    before = threading.active_count()
    with pytest.raises(error):
        list(run_all(work, range(100), workers))
    assert len(begun) < 10
    end = time.monotonic() + (SOON_S if error is KeyboardInterrupt else 0.0)
    while threading.active_count() > before and time.monotonic() < end:
        time.sleep(0.01)
    assert threading.active_count() == before


def test_an_interrupt_of_the_consumer_ends_the_run():
    begun = []
    results = run_all(begun.append, range(100), 2)
    next(results)
    with pytest.raises(KeyboardInterrupt):
        results.throw(KeyboardInterrupt())
    assert len(begun) <= 4


def test_an_interrupt_does_not_wait_for_what_runs():
    """Of two tasks one waits for minutes; the command may ask whether it still does."""
    go_on = threading.Event()

    def work(x):
        if x == 0:
            go_on.wait(300.0)
        else:
            raise KeyboardInterrupt

    assert not is_busy()
    start = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        list(run_all(work, range(9), 2))
    assert time.monotonic() - start < SOON_S
    assert is_busy()
    go_on.set()
    while is_busy():
        assert time.monotonic() - start < SOON_S
        time.sleep(0.01)
