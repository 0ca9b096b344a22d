"""The heights of a run: those at which a surface is expected, and those that are searched beyond them."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class HeightRange:
    """Lowest and highest height, m: `expected` of the surface, and `searched` where images clearly agree beyond it."""

    expected: tuple[float, float]
    searched: tuple[float, float]

    @classmethod
    def limited_to(cls, heights: tuple[float, float]) -> HeightRange:
        """A range beyond which nothing is searched."""
        return cls(heights, heights)

    @property
    def middle(self) -> float:
        """Middle of the heights at which the surface is expected, m: where ground pixels and parallax are computed."""
        return (self.expected[0] + self.expected[1]) / 2
