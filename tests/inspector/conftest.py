"""What the tests of the inspector share."""

from __future__ import annotations

import pytest


@pytest.fixture(scope="session")
def block(tmp_path_factory):
    """The folder and the scene of a run over a block beside level ground, see `block_scene`."""
    from block_scene import block_surface

    return block_surface(tmp_path_factory)
