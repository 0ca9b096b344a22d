"""The stored plan of a run in tasks: how tiles are dealt out, and how tasks are named."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zlocus.core.errors import ConfigError
from zlocus.pipeline.array_plan import ArrayPlan, as_ranges, most_tiles, stored_plan


def planned(n_tiles, n_tasks):
    names = tuple(f"0_{k}" for k in range(n_tiles))
    return ArrayPlan(Path("out"), n_tasks, names, {}, "", "", "", (), 300.0, 2.0, 1.0)


@given(st.integers(1, 60), st.integers(1, 60))
def test_every_tile_belongs_to_one_task_and_tasks_have_equal_numbers(n_tiles, n_tasks):
    plan = planned(n_tiles, n_tasks)
    dealt = [plan.names_of(number) for number in range(1, plan.n_tasks + 1)]
    assert [name for names in dealt for name in names] == list(plan.names)
    sizes = {len(names) for names in dealt}
    assert max(sizes) - min(sizes) <= 1
    assert max(sizes) == most_tiles(n_tiles, n_tasks)


def test_tasks_are_left_until_all_of_their_tiles_are_there():
    plan = planned(7, 3)
    assert plan.left([]) == [1, 2, 3]
    assert plan.left(plan.names_of(2)) == [1, 3]
    assert plan.left(plan.names[:-1]) == [3]
    assert plan.left(plan.names) == []
    for number in (0, 4):
        with pytest.raises(ConfigError, match=f"{number} is none of them"):
            plan.names_of(number)


def test_numbers_are_written_as_schedulers_read_them():
    assert as_ranges([]) == ""
    assert as_ranges([4]) == "4"
    assert as_ranges([1, 2, 3, 7, 9, 10]) == "1-3,7,9-10"
    assert as_ranges([1, 3, 5, 7], most=3) == "1,3,5 and more"
    assert as_ranges([1, 3, 5], most=3) == "1,3,5"


@given(st.sets(st.integers(1, 40)))
def test_ranges_hold_the_numbers(numbers):
    found = set()
    for part in filter(None, as_ranges(sorted(numbers)).split(",")):
        first, _, last = part.partition("-")
        found |= set(range(int(first), int(last or first) + 1))
    assert found == numbers


def test_what_is_no_plan_is_none(tmp_path):
    (tmp_path / "tiles").mkdir()
    for text in ("", "[]", "{}", '{"schema": 1}', '{"schema": 2, "names": []}', "[" * 100_000):
        (tmp_path / "tiles" / "plan.json").write_text(text)
        (tmp_path / "tiles" / "manifest.json").write_text('{"key": {}}')
        assert stored_plan(tmp_path) is None


def test_the_plan_of_a_surface_without_tiles_says_so():
    assert "no tile shows ground that two images see" in str(planned(0, 0))
