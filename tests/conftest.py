"""What every test shares: the data folder, and runs that repeat exactly."""

from __future__ import annotations

import os
from pathlib import Path

# One thread per test process, set before Numba reads it.
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import pytest
from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, deadline=None, max_examples=50, database=None)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real and rendered scenes, from ZLOCUS_TEST_DATA; the test is skipped without it."""
    folder = os.environ.get("ZLOCUS_TEST_DATA")
    if not folder:
        pytest.skip("ZLOCUS_TEST_DATA is not set: no shared scenes to test on")
    path = Path(folder)
    if not path.is_dir():
        pytest.fail(f"ZLOCUS_TEST_DATA is {folder}, which is not a folder")
    return path


@pytest.fixture(scope="session")
def images(tmp_path_factory):
    """Images of an analytic ground, rendered once: `images(kind)`."""
    from rendered_scenes import rendered

    made = {}

    def of(kind):
        if kind not in made:
            made[kind] = rendered(tmp_path_factory.mktemp(kind), kind)
        return made[kind]

    return of
