"""Symmetric positive definite matrices whose unknowns are linked to near ones only, as those of a block of images are.

In a suitable order such a matrix is block tridiagonal: the unknowns form groups, and each group is linked to the group
before it and the one after it. Its factorisation, the solution of equations and the diagonal of its inverse then take
time and memory in proportion to the number of groups.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from zlocus.core.sensor_model import FloatArray

# Groups are at least this large, because the algebra of many small matrices is slow.
MIN_GROUP = 64


@dataclass(frozen=True, eq=False)
class BlockTridiagonal:
    """Factorisation of a symmetric positive definite matrix A (p, p).

    order : (p,) numbers of the unknowns in the order of the groups; edges : (g + 1,) where each group begins in it, and
    p; factors : the lower triangles L_i of the groups, L_i L_i^T = A_ii - W_i^T W_i; links : the matrices
    W_i = L_(i-1)^-1 A_(i-1),i of the groups 1, 2, ... (W_0 = 0).
    """

    order: NDArray[np.int64]
    edges: NDArray[np.int64]
    factors: tuple[FloatArray, ...]
    links: tuple[FloatArray, ...]

    @classmethod
    def of(cls, matrix: Any) -> BlockTridiagonal:
        """Factorise a sparse matrix (p, p).

        Source: block Gaussian elimination (Golub and Van Loan 2013, Matrix Computations, section 4.5.1), after the
        order of Cuthill and McKee (1969), Reducing the bandwidth of sparse symmetric matrices, reversed.

        Raises
        ------
        numpy.linalg.LinAlgError
            The matrix is not positive definite.
        """
        matrix = csr_array(matrix)
        order = np.asarray(reverse_cuthill_mckee(matrix, symmetric_mode=True), np.int64)
        matrix = matrix[order][:, order].tocsr()
        edges = group_edges(matrix)
        factors: list[FloatArray] = []
        links: list[FloatArray] = []
        for i, (first, end) in enumerate(pairwise(edges.tolist())):
            pivot = matrix[first:end, first:end].toarray()
            if i:
                beside = matrix[edges[i - 1] : first, first:end].toarray()
                links.append(_solved(factors[-1], beside))
                pivot -= links[-1].T @ links[-1]
            factors.append(np.asarray(linalg.cholesky(pivot, lower=True)))
        return cls(order, edges, tuple(factors), tuple(links))

    def solve(self, right: FloatArray) -> FloatArray:
        """A^-1 right; right : (p,) or (p, k)."""
        parts = np.split(right[self.order], self.edges[1:-1])
        parts[0] = _solved(self.factors[0], parts[0])
        for i, link in enumerate(self.links):
            parts[i + 1] = _solved(self.factors[i + 1], parts[i + 1] - link.T @ parts[i])
        parts[-1] = _solved(self.factors[-1], parts[-1], is_turned=True)
        for i in range(len(self.links) - 1, -1, -1):
            parts[i] = _solved(self.factors[i], parts[i] - self.links[i] @ parts[i + 1], is_turned=True)
        solution = np.empty_like(right, dtype=float)
        solution[self.order] = np.concatenate(parts)
        return solution

    def inverse_diagonal(self) -> FloatArray:
        """Diagonal (p,) of A^-1.

        The blocks on the diagonal follow from the last to the first:
        G_i = L_i^-T (1 + W_(i+1) G_(i+1) W_(i+1)^T) L_i^-1.
        """
        diagonal, last = np.empty(len(self.order)), None
        for i in range(len(self.factors) - 1, -1, -1):
            inner = np.eye(int(self.edges[i + 1] - self.edges[i]))
            if last is not None:
                inner += self.links[i] @ last @ self.links[i].T
            block = _solved(self.factors[i], _solved(self.factors[i], inner, is_turned=True).T, is_turned=True)
            diagonal[self.order[self.edges[i] : self.edges[i + 1]]] = np.diag(block)
            last = block
        return diagonal


def _solved(lower: FloatArray, right: FloatArray, is_turned: bool = False) -> FloatArray:
    """L^-1 right, or L^-T right. lower : (n, n), L; right : (n,) or (n, k)."""
    solved = linalg.solve_triangular(lower, right, lower=True, trans=1 if is_turned else 0, check_finite=False)
    return np.asarray(solved)


def group_edges(matrix: Any) -> NDArray[np.int64]:
    """Where groups of unknowns begin (g + 1,), and p, so that each is linked to the groups beside it only.

    matrix : sparse (p, p) with a symmetric pattern, in the order of the unknowns. A group begins after the last unknown
    that is linked to the group before it.
    """
    size = matrix.shape[0]
    entries = matrix.tocoo()
    farthest = np.arange(size)
    np.maximum.at(farthest, entries.row, entries.col)
    # The last unknown that is linked to any unknown up to this one.
    farthest = np.maximum.accumulate(farthest)
    edges = [0]
    end = min(MIN_GROUP, size)
    while edges[-1] < size:
        edges.append(end)
        end = min(max(int(farthest[end - 1]) + 1, end + MIN_GROUP), size)
    return np.array(edges, np.int64)
