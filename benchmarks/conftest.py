"""Options of the benchmarks: `python -m pytest benchmarks --benchmark-enable --benchmark-only --side 64`."""

from __future__ import annotations

import pytest

LEAST_SIDE = 64


def pytest_addoption(parser):
    parser.addoption(
        "--side",
        type=int,
        metavar="CELLS",
        help=f"side of the made-up scenes, a multiple of {LEAST_SIDE}; without it each scene has its own",
    )


def pytest_configure(config):
    side = config.getoption("--side")
    if side is not None and (side < LEAST_SIDE or side % LEAST_SIDE):
        raise pytest.UsageError(f"--side is {side}: give a multiple of {LEAST_SIDE}.")


@pytest.fixture
def side(request):
    """Cells along a side from the command line; None for the usual size of each scene."""
    return request.config.getoption("--side")
