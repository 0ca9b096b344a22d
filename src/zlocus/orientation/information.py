"""Information that ties and control give about the parameters of a bundle adjustment, and the covariance from it.

Small problems use dense matrices. In large blocks each image is linked to its neighbours only, and the matrices are
sparse: time and memory then grow in proportion to the number of images, and not with its third power and its square.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from scipy import linalg, sparse

from zlocus.core.sensor_model import FloatArray
from zlocus.orientation.block_tridiagonal import BlockTridiagonal

# Problems with at most so many parameters are solved with dense matrices: those of 200 frame cameras.
MAX_DENSE_PARAMETERS = 1200
# Iteration towards the weak directions of a sparse matrix: directions at first, largest number of rounds, and the
# residual at which it ends, as a share of the limit.
FIRST_DIRECTIONS, MAX_ROUNDS, RESIDUAL_SHARE = 16, 60, 0.01


class Covariance(Protocol):
    """Covariance matrix (p, p) of the parameters, in units of their sigma."""

    @property
    def variances(self) -> FloatArray:
        """Its diagonal (p,)."""
        ...

    def times(self, vector: FloatArray) -> FloatArray:
        """Its product with a vector (p,)."""
        ...


class Information(Protocol):
    """Normal matrix (p, p) px2 of the parameters, without what is known of them beforehand."""

    def covariance(self, sigma: float, variance: FloatArray) -> Covariance:
        """The inverse of the normal matrix over sigma squared, plus the information known beforehand.

        sigma : noise of the image coordinates, px; variance : (p,) prior variances.
        """
        ...


@dataclass(frozen=True, eq=False)
class DenseCovariance:
    """See `Covariance`. matrix : (p, p)."""

    matrix: FloatArray

    @property
    def variances(self) -> FloatArray:
        """See `Covariance`."""
        return np.asarray(np.diag(self.matrix))

    def times(self, vector: FloatArray) -> FloatArray:
        """See `Covariance`."""
        return np.asarray(self.matrix @ vector)


@dataclass(frozen=True, eq=False)
class DenseInformation:
    """See `Information`. normal : (p, p) px2."""

    normal: FloatArray

    def covariance(self, sigma: float, variance: FloatArray) -> DenseCovariance:
        """See `Information`."""
        return DenseCovariance(np.asarray(linalg.inv(self.normal / sigma**2 + np.diag(1.0 / variance))))


@dataclass(frozen=True, eq=False)
class SparseCovariance:
    """See `Covariance`: A^-1 - Z C^-1 Z^T, the inverse of A + U K U^T (Woodbury's formula), with Z = A^-1 U and
    C = K^-1 + U^T Z.

    block_tridiagonal : of A; solved : (p, k), Z; middle : (k, k), C.
    """

    block_tridiagonal: BlockTridiagonal
    solved: FloatArray
    middle: FloatArray

    @cached_property
    def variances(self) -> FloatArray:
        """See `Covariance`."""
        weighted = self.solved @ np.linalg.inv(self.middle)
        return np.asarray(self.block_tridiagonal.inverse_diagonal() - (weighted * self.solved).sum(axis=1))

    def times(self, vector: FloatArray) -> FloatArray:
        """See `Covariance`."""
        return np.asarray(
            self.block_tridiagonal.solve(vector) - self.solved @ np.linalg.solve(self.middle, self.solved.T @ vector)
        )


@dataclass(frozen=True, eq=False)
class SparseInformation:
    """See `Information`: N + U K U^T with U = [a, W] and K = [[M, -1], [-1, 0]], where M = b^T W.

    normal : sparse (p, p) px2, N, of all information; ahead : (p, k), a; lost : (p, k) px2, W; back : (p, k), b. What
    is added takes the information of ties in their weak directions away, see `WeakDirections`.
    """

    normal: Any
    ahead: FloatArray
    lost: FloatArray
    back: FloatArray

    def covariance(self, sigma: float, variance: FloatArray) -> SparseCovariance:
        """See `Information`."""
        k = self.ahead.shape[1]
        factored = BlockTridiagonal.of(self.normal / sigma**2 + diagonal_matrix(1.0 / variance))
        outer = np.column_stack([self.ahead, self.lost])
        none, one = np.zeros((k, k)), np.eye(k)
        inverse_of_middle = np.block([[none, -one], [-one, -(self.back.T @ self.lost)]]) * sigma**2
        solved = factored.solve(outer)
        return SparseCovariance(factored, solved, inverse_of_middle + outer.T @ solved)


def diagonal_matrix(values: FloatArray) -> Any:
    """Sparse matrix (p, p) with these values (p,) on its diagonal; `sparse.diags_array` is not in every SciPy."""
    return sparse.dia_array((values[None], [0]), shape=(len(values), len(values)))


@dataclass(frozen=True, eq=False)
class WeakDirections:
    """Directions of the parameters that ties hardly determine.

    They would absorb the small common errors of all ties, enlarged. So the information of ties in these directions is
    left out, and priors and control decide.

    ahead, back : (p, k), whose product ahead @ back.T takes the share of the weak directions from a pull of the ties;
    n : number of directions, with those of parameters that no tie depends on.
    """

    ahead: FloatArray
    back: FloatArray
    n: int

    def information_without(self, full_normal: Any, tie_normal: Any) -> Information:
        """All information, except that of ties in the weak directions. full_normal, tie_normal : (p, p) px2, of all
        information and of ties, both dense or both sparse."""
        if not isinstance(tie_normal, np.ndarray):
            return SparseInformation(full_normal, self.ahead, tie_normal @ self.back, self.back)
        left = tie_normal - self.ahead @ (self.back.T @ tie_normal)
        determined = left - (left @ self.back) @ self.ahead.T
        return DenseInformation(full_normal - tie_normal + determined)

    def pull_without(self, full_pull: FloatArray, tie_pull: FloatArray) -> FloatArray:
        """Pull (p,) of all information, except that of ties in the weak directions."""
        return np.asarray(full_pull - self.ahead @ (self.back.T @ tie_pull))


def weak_directions(normal: Any, scale: FloatArray, n_views: int) -> WeakDirections:
    """Directions in which ties have almost no information per image point.

    See `parameter_groups.MIN_INFORMATION_IN_IMAGE`.

    normal : (p, p) of the ties alone, dense or sparse; scale : (p,) square root of the information that a parameter
    needs, 0 where no tie depends on it; n_views : number of images with ties.
    """
    linked, limit = scale > 0.0, 1.0 / n_views**2
    inverse = np.where(linked, 1.0 / np.where(linked, scale, 1.0), 0.0)
    if isinstance(normal, np.ndarray):
        _, vectors = linalg.eigh(normal * inverse[:, None] * inverse, subset_by_value=(-np.inf, limit))
        return WeakDirections(scale[:, None] * vectors, inverse[:, None] * vectors, vectors.shape[1])
    of_linked = diagonal_matrix(inverse[linked])
    scaled = of_linked @ normal.tocsr()[linked][:, linked] @ of_linked
    found = smallest_eigenvectors(scaled, limit)
    vectors = np.zeros((len(scale), found.shape[1]))
    vectors[linked] = found
    n = found.shape[1] + int((~linked).sum())
    return WeakDirections(scale[:, None] * vectors, inverse[:, None] * vectors, n)


def smallest_eigenvectors(matrix: Any, limit: float) -> FloatArray:
    """Orthonormal eigenvectors (p, k) of a positive semidefinite sparse matrix (p, p) with eigenvalues below a limit.

    Inverse iteration with a subspace (Golub and Van Loan 2013, Matrix Computations, section 8.2.4), which is doubled
    until it has eigenvalues above the limit. Where it does not converge the matrix is taken as dense.
    """
    size = matrix.shape[0]
    factored = BlockTridiagonal.of(matrix + diagonal_matrix(np.full(size, limit)))
    n_directions = FIRST_DIRECTIONS
    while n_directions < size // 4:
        basis, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((size, n_directions)))
        for _ in range(MAX_ROUNDS):
            basis, _ = np.linalg.qr(factored.solve(basis))
            values, turned = np.linalg.eigh(basis.T @ (matrix @ basis))
            below = basis @ turned[:, values < limit]
            residual = matrix @ below - below * values[values < limit]
            if values[-1] >= limit and np.linalg.norm(residual, axis=0).max(initial=0.0) <= RESIDUAL_SHARE * limit:
                return np.asarray(below)
        n_directions *= 2
    _, vectors = linalg.eigh(matrix.toarray(), subset_by_value=(-np.inf, limit))
    return np.asarray(vectors)
