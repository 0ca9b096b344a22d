"""Tasks that fail, and are tried again where that may help; in this process and in others."""

from __future__ import annotations

import os
import sys
import time
from contextlib import nullcontext
from dataclasses import dataclass

import pytest

from worker_tasks import Hungry, Planted, Sleeping
from zlocus.core.errors import GeometryError, InputError
from zlocus.pipeline.execution.processes import ONE_THREAD, Processes
from zlocus.pipeline.execution.tasks import MAX_ATTEMPTS, Cause, Here, Outcome, failure_of, run_tasks

STOPS_WITHIN_S = 5.0


def workers(function, slots):
    return nullcontext(Here(function)) if slots == 0 else Processes(function, slots)


def run(function, tasks, slots):
    with workers(function, slots) as ready:
        return list(run_tasks(ready, tasks))


def final(outcomes):
    return {o.task: o for o in outcomes if o.is_final}


@pytest.mark.parametrize("slots", [0, 1, 3])
def test_every_task_has_a_result(tmp_path, slots):
    outcomes = run(Planted(tmp_path), range(9), slots)
    assert sorted(o.result[0] for o in outcomes) == [n * n for n in range(9)]
    assert all(o.is_final and o.attempt == 1 and o.failure is None for o in outcomes)
    processes = {o.result[1] for o in outcomes}
    assert (os.getpid() in processes) == (slots == 0)
    assert len(processes) <= max(slots, 1)
    assert all(o.peak_mb > 10 and o.wall_s >= 0 for o in outcomes)


@pytest.mark.parametrize("slots", [0, 2])
def test_what_may_pass_is_tried_again_when_the_others_are_done(tmp_path, slots):
    planted = Planted(tmp_path, exhaust=(1,), miss=(3,), break_=(5,))
    outcomes = run(planted, range(8), slots)
    ends = final(outcomes)
    assert {n for n, o in ends.items() if o.failure} == {1, 3, 5}
    assert [planted.attempts(n) for n in (0, 1, 3, 5)] == [1, MAX_ATTEMPTS, MAX_ATTEMPTS, 1]
    assert (ends[1].failure.cause, ends[3].failure.cause, ends[5].failure.cause) == (
        Cause.MEMORY, Cause.INPUT, Cause.FAULT,
    )  # fmt: skip
    assert ends[3].failure.reason == "a.tif is gone. Bring it back"
    assert "IndexError: index 7" in ends[5].failure.reason
    assert "_fail" in ends[5].failure.trace
    first_again = next(i for i, o in enumerate(outcomes) if o.attempt > 1)
    assert {o.task for o in outcomes[:first_again]} >= {0, 2, 4, 6, 7}
    assert [o.is_final for o in outcomes if o.task == 1] == [False] * (MAX_ATTEMPTS - 1) + [True]


def test_a_task_that_passes_at_last(tmp_path):
    outcomes = run(Planted(tmp_path, kill=(2,), exhaust=(4,), passes_after=MAX_ATTEMPTS - 1), range(6), 2)
    assert {n: o.result[0] for n, o in final(outcomes).items()} == {n: n * n for n in range(6)}
    assert sum(o.failure is not None for o in outcomes) == 2 * (MAX_ATTEMPTS - 1)


@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc and limits of memory, which Linux has")
def test_a_worker_that_runs_out_of_memory_works_on(tmp_path):
    ends = final(run(Hungry(3), range(8), 2))
    assert {n for n, o in ends.items() if o.failure} == {3}
    assert ends[3].failure.cause is Cause.MEMORY
    assert ends[3].attempt == MAX_ATTEMPTS
    assert {n: o.result for n, o in ends.items() if n != 3} == {n: n for n in range(8) if n != 3}


def test_a_worker_that_is_killed_costs_its_task_only(tmp_path):
    planted = Planted(tmp_path, kill=(3, 7))
    ends = final(run(planted, range(12), 2))
    assert {n for n, o in ends.items() if o.failure} == {3, 7}
    for n in (3, 7):
        assert ends[n].failure.cause is Cause.LOST
        assert "killed (signal 9), as the system does when memory runs out" in ends[n].failure.reason
    assert all(planted.attempts(n) == 1 for n in range(12) if n not in (3, 7))


@dataclass
class OneByOne:
    """Workers of three slots that say how many tasks they hold."""

    slots: int = 3

    def __post_init__(self):
        self.held, self.most = [], {}

    def submit(self, task):
        self.held.append(task)
        self.most[task] = max(self.most.get(task, 0), len(self.held))
        assert len(self.held) <= self.slots

    def wait(self):
        task = self.held.pop(0)
        return [Outcome(task, failure=failure_of(MemoryError()) if task == "large" else None)]


def test_what_failed_is_tried_again_alone():
    ready = OneByOne()
    outcomes = list(run_tasks(ready, ["a", "large", "b", "c"]))
    assert len(outcomes) == 3 + MAX_ATTEMPTS
    assert ready.most["c"] == 3
    ready = OneByOne()
    ready.most.clear()
    list(run_tasks(ready, ["large"]))
    assert ready.most == {"large": 1}


def test_failures_by_their_cause():
    assert failure_of(MemoryError()).may_pass
    assert failure_of(OSError(5, "Input/output error")).reason == "OSError: [Errno 5] Input/output error"
    assert failure_of(InputError("b.tif is bad.")).reason == "b.tif is bad"
    geometry = failure_of(GeometryError("no."))
    assert (geometry.may_pass, geometry.trace, str(geometry.error)) == (False, "", "no.")
    assert failure_of(ValueError("x")).error is None


def test_leaving_stops_workers_whatever_they_do():
    start = time.monotonic()
    with Processes(Sleeping(60.0), 2) as ready:
        ready.submit(1)
        ready.submit(2)
        running = [worker.process for worker in ready._busy]
    assert time.monotonic() - start < STOPS_WITHIN_S
    assert not any(process.is_alive() for process in running)


def test_the_environment_is_as_it_was(tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("GDAL_NUM_THREADS", raising=False)
    run(Planted(tmp_path), [1], 1)
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "GDAL_NUM_THREADS" not in os.environ
    assert set(ONE_THREAD.values()) == {"1"}
