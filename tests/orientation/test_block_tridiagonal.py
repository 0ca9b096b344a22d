"""Block tridiagonal matrices against dense ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from zlocus.orientation import block_tridiagonal
from zlocus.orientation.block_tridiagonal import BlockTridiagonal, group_edges

RELATIVE = 1e-9


def linked_matrix(n, links, seed):
    """A positive definite matrix (n, n) in which some pairs of unknowns are linked."""
    rng = np.random.default_rng(seed)
    matrix = np.zeros((n, n))
    for a, b in links:
        matrix[a % n, b % n] = matrix[b % n, a % n] = rng.uniform(-1.0, 1.0)
    np.fill_diagonal(matrix, np.abs(matrix).sum(axis=1) + rng.uniform(0.1, 1.0, n))
    return matrix


@settings(deadline=None, max_examples=80)
@given(
    st.integers(1, 25), st.lists(st.tuples(st.integers(0, 24), st.integers(0, 24)), max_size=50),
    st.integers(0, 1000), st.integers(1, 7),
)  # fmt: skip
def test_solutions_and_the_diagonal_of_the_inverse_are_the_dense_ones(n, links, seed, min_group):
    """Whatever is linked, also nothing or everything, and whatever the smallest group is."""
    matrix = linked_matrix(n, links, seed)
    right = np.random.default_rng(seed + 1).normal(size=(n, 3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(block_tridiagonal, "MIN_GROUP", min_group)
        found = BlockTridiagonal.of(sparse.csr_array(matrix))
    inverse = np.linalg.inv(matrix)
    scale = RELATIVE * np.abs(inverse).max()
    np.testing.assert_allclose(found.solve(right), inverse @ right, rtol=RELATIVE, atol=scale)
    np.testing.assert_allclose(found.solve(right[:, 0]), inverse @ right[:, 0], rtol=RELATIVE, atol=scale)
    np.testing.assert_allclose(found.inverse_diagonal(), np.diag(inverse), rtol=RELATIVE, atol=scale)


def test_a_chain_has_small_groups(monkeypatch):
    """Their number grows with its length, their size does not."""
    monkeypatch.setattr(block_tridiagonal, "MIN_GROUP", 4)
    n = 200
    links = [(k, k + step) for k in range(n - 3) for step in (1, 2, 3)]
    shuffled = np.random.default_rng(5).permutation(n)
    found = BlockTridiagonal.of(sparse.csr_array(linked_matrix(n, links, 2)[shuffled][:, shuffled]))
    assert np.diff(found.edges).max() <= 8
    assert sorted(found.order.tolist()) == list(range(n))


def test_groups_are_linked_to_the_groups_beside_them_only(monkeypatch):
    monkeypatch.setattr(block_tridiagonal, "MIN_GROUP", 2)
    matrix = sparse.csr_array(linked_matrix(12, [(0, 5), (3, 4), (6, 9), (2, 3)], 0))
    edges = group_edges(matrix)
    group = np.searchsorted(edges, np.arange(12), side="right") - 1
    row, col = matrix.nonzero()
    assert np.abs(group[row] - group[col]).max() <= 1
    assert edges[0] == 0
    assert edges[-1] == 12
    assert (np.diff(edges) > 0).all()


def test_a_matrix_that_is_not_positive_definite_is_refused():
    with pytest.raises(np.linalg.LinAlgError):
        BlockTridiagonal.of(sparse.csr_array(np.diag([1.0, -1.0, 2.0])))
