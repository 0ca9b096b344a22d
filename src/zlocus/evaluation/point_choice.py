"""A random choice of points that are read some after others, so that any number of them fits in memory."""

from __future__ import annotations

import numpy as np

from zlocus.core.sensor_model import FloatArray
from zlocus.io.points.ground_points import KnownPoints

SEED = 0


class PointChoice:
    """At most `most` of the points that are added, all equally likely, in the order in which they came.

    n : number of points that were added.
    """

    def __init__(self, most: int) -> None:
        self._most, self._random = most, np.random.default_rng(SEED)
        self._parts: list[KnownPoints] = []
        self._values: list[FloatArray] = []
        self._priorities: list[FloatArray] = []
        self.n = 0

    def add(self, points: KnownPoints, values: FloatArray | None = None) -> None:
        """Add points. values : (n,) a number of each, kept with it."""
        self.n += len(points)
        self._parts.append(points)
        self._values.append(np.full(len(points), np.nan) if values is None else values)
        self._priorities.append(self._random.random(len(points)))
        if sum(map(len, self._parts)) > 2 * self._most:
            self._reduce()

    @property
    def points(self) -> KnownPoints:
        """The chosen points."""
        self._reduce()
        return self._parts[0]

    @property
    def values(self) -> FloatArray:
        """The numbers (n,) of the chosen points."""
        self._reduce()
        return self._values[0]

    def _reduce(self) -> None:
        points, values = KnownPoints.joined(self._parts), np.concatenate(self._values)
        priorities = np.concatenate(self._priorities)
        if len(points) > self._most:
            chosen = np.sort(np.argpartition(priorities, self._most)[: self._most])
            points, values, priorities = points.where(chosen), values[chosen], priorities[chosen]
        self._parts, self._values, self._priorities = [points], [values], [priorities]
