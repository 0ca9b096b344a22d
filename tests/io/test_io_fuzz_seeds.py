"""Seeds of coverage-guided fuzzing (`fuzz.py`) for every format: inputs that reach rare code, and earlier faults."""

from __future__ import annotations

import pytest

from damage_cases import CASES
from damage_outcomes import Good, outcome
from places import TESTS

SEEDS = TESTS / "fuzz_seeds"


@pytest.mark.parametrize("name", CASES)
def test_every_seed_is_read_or_refused(name, tmp_path):
    case, seeds = CASES[name], sorted((SEEDS / name).iterdir())
    assert seeds, "python tests/support/fuzz.py finds some"
    path = case.write(tmp_path)
    good = Good(case, path, path.read_bytes(), {})
    for seed in seeds:
        outcome(good, seed.read_bytes())
