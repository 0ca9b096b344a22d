"""What fuzzing found, read again: an answer or one sentence, in time and memory (see `fuzz.py`)."""

from __future__ import annotations

import pytest

from damage_cases import CASES
from fuzz import SEEDS
from test_damage import Good, outcome

FORMATS = sorted(folder.name for folder in SEEDS.iterdir())


def test_every_format_was_fuzzed():
    assert set(FORMATS) == set(CASES)


@pytest.mark.parametrize("name", FORMATS)
def test_seeds(name, tmp_path):
    case = CASES[name]
    path = case.write(tmp_path)
    whole = Good(case, path, path.read_bytes(), case.read(path))
    seeds = sorted((SEEDS / name).iterdir())
    assert seeds
    for seed in seeds:
        outcome(whole, seed.read_bytes())
