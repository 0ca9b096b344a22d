from __future__ import annotations

import pytest

from zlocus.core.quoting import first_names


@pytest.mark.parametrize(
    ("names", "said"), [([], ""), (["a"], "a"), (["a", "b"], "a, b"), (["a", "b", "c", "d"], "a, b and 2 more")]
)
def test_first_names(names, said):
    assert first_names(names, 2) == said
