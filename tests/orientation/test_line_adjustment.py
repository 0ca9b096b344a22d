"""Displacements of image lines from the residuals of ties."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from zlocus.orientation import line_adjustment
from zlocus.orientation.line_adjustment import estimated_line_shifts, no_line_shifts, without_line_shifts
from zlocus.orientation.triangulate import Observations, triangulate

GSD_M, SIDE_PX, NOISE_PX, WAVE_PX = 0.5, 800, 0.05, 0.15
LEFT_SHARE = 0.3
HEIGHT_M = 0.02


@dataclass(frozen=True)
class Pushbroom:
    """A satellite with rows to the south; a point moves by `slope` metres to the south for each metre of height."""

    slope: float
    heights: tuple[float, float] | None = (0.0, 200.0)

    def image_from_ground(self, xyz):
        return np.column_stack([xyz[:, 0], SIDE_PX * GSD_M - xyz[:, 1] + self.slope * xyz[:, 2]]) / GSD_M

    def height_bounds(self):
        return self.heights


def views_of(slopes, heights=(0.0, 200.0)):
    image = SimpleNamespace(shape=(SIDE_PX, SIDE_PX))
    return [SimpleNamespace(sensor=Pushbroom(slope, heights), image=image) for slope in slopes]


def waves(n_views, seed=4):
    """Displacements (n, 2) px of lines, a function of each view: waves of 250 and of 600 lines."""
    rng = np.random.default_rng(seed)
    phases = rng.uniform(0.0, 2.0 * np.pi, (n_views, 2, 2))

    def displacement(view, row):
        angle = 2.0 * np.pi * row[:, None, None] / np.array([250.0, 600.0]) + phases[view]
        return WAVE_PX * np.sin(angle).mean(axis=2)

    return displacement


def adjusted(views, displacement=None, n=900, seed=5):
    """Ties in hilly ground, seen in all views, as an adjustment leaves them."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(0.0, SIDE_PX * GSD_M, (n, 2))
    xyz = np.column_stack([xy, 60.0 + 40.0 * np.sin(xy[:, 0] / 50.0) * np.sin(xy[:, 1] / 70.0)])
    seen = []
    for number, view in enumerate(views):
        model = view.sensor.image_from_ground(xyz)
        off = 0.0 if displacement is None else displacement(number, model[:, 1])
        seen.append(model + off + rng.normal(0.0, NOISE_PX, model.shape))
    number, point = np.repeat(np.arange(len(views)), n), np.tile(np.arange(n), len(views))
    observations = Observations(number, point, np.concatenate(seen))
    sensors = [view.sensor for view in views]
    return SimpleNamespace(observations=observations, ground_points=triangulate(sensors, observations, xyz))


def across(views, adjustment, displacement):
    """Differences of the columns' displacements of the first two views at the ties, px: true, and found."""
    observations, line_shifts = adjustment.observations, estimated_line_shifts(views, adjustment)
    rows = [observations.xy[observations.view == number, 1] for number in (0, 1)]
    true = displacement(0, rows[0])[:, 0] - displacement(1, rows[1])[:, 0]
    found = line_shifts[0].at(rows[0])[:, 0] - line_shifts[1].at(rows[1])[:, 0]
    return true - true.mean(), found - found.mean()


@pytest.mark.parametrize("slopes", [(0.0, 0.3), (0.0, 0.3, -0.3)])
def test_displacements_across_the_parallax_are_found(slopes):
    views, displacement = views_of(slopes), waves(len(slopes))
    true, found = across(views, adjusted(views, displacement), displacement)
    assert true.std() > 0.3 * WAVE_PX
    assert (true - found).std() < LEFT_SHARE * true.std()


@pytest.mark.parametrize("slopes", [(0.0, 0.3), (0.0, 0.3, -0.3)])
def test_heights_stay_where_they_are(slopes):
    views, displacement = views_of(slopes), waves(len(slopes))
    adjustment = adjusted(views, displacement)
    straight = without_line_shifts(adjustment.observations, estimated_line_shifts(views, adjustment))
    moved = triangulate([view.sensor for view in views], straight, adjustment.ground_points.xyz)
    z, before = moved.xyz[:, 2], adjustment.ground_points.xyz[:, 2]
    assert np.sqrt(np.mean((z - before) ** 2)) < HEIGHT_M
    assert np.std(moved.residual) < 0.8 * np.std(adjustment.ground_points.residual)


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_no_displacement(seed):
    views = views_of((0.0, 0.3, -0.3))
    assert not any(estimated_line_shifts(views, adjusted(views, seed=seed)))


def test_cameras_without_lines_and_images_without_ties_have_none():
    frames = views_of((0.0, 0.3), heights=None)
    adjustment = adjusted(frames, waves(2))
    assert estimated_line_shifts(frames, adjustment) == no_line_shifts(frames)
    views = views_of((0.0, 0.3))
    few = adjusted(views, waves(2), n=20)
    assert estimated_line_shifts(views, few) == (None, None)


def test_observations_of_other_views_stay_as_they_are():
    views, displacement = views_of((0.0, 0.3)), waves(2)
    adjustment = adjusted(views, displacement)
    found = estimated_line_shifts(views, adjustment)
    straight = without_line_shifts(adjustment.observations, (found[0], None))
    mine = adjustment.observations.view == 0
    assert np.array_equal(straight.xy[~mine], adjustment.observations.xy[~mine])
    moved = adjustment.observations.xy[mine] - straight.xy[mine]
    np.testing.assert_allclose(moved, found[0].at(adjustment.observations.xy[mine, 1]))
    assert replace(found[0], shift_px=found[0].shift_px * 0.0).max_px == 0.0


@pytest.mark.parametrize("n_nodes", [2, 13, 60])
def test_the_likeliest_process_is_that_of_plain_formulas(n_nodes):
    """Rasmussen and Williams 2006, equation 2.30, with a determinant and a solution for each process."""
    rng = np.random.default_rng(n_nodes)
    for strength in (0.0, 1.0, 30.0, 1000.0):
        root = rng.normal(size=(3 * n_nodes, n_nodes))
        normal, pull = root.T @ root, strength * rng.normal(size=n_nodes)
        odds = []
        for process in line_adjustment._processes(n_nodes):
            both = normal + process.precision
            explained = pull @ np.linalg.solve(both, pull)
            odds.append(0.5 * (process.log_determinant - np.linalg.slogdet(both)[1] + explained))
        best, found = int(np.argmax(odds)), line_adjustment._likeliest(normal, pull)
        if max(odds) > line_adjustment.MIN_LOG_ODDS:
            expected = line_adjustment._processes(n_nodes)[best]
            assert found.log_determinant == expected.log_determinant
            np.testing.assert_array_equal(found.precision, expected.precision)
        else:
            assert found is None
