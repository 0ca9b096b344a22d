"""Heights of a hillside of 45 degrees, from six views, follow the slope and form no stairs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rendered_scenes import CENTRE, FIELD, GSD_M, SIZE_PX, UTM, read, run
from zlocus.matching import finest_level
from zlocus.matching.slope_surface import SlopeSurface
from zlocus.sensors.rpc_fit import fit_rpc
from zlocus.synthetic.cameras import SatelliteCamera
from zlocus.synthetic.files import write_image
from zlocus.synthetic.render import Optics, Sun, expose, render
from zlocus.synthetic.terrain import analytic_ground

# Metres of height per metre east and north: 45 degrees of slope.
EAST, NORTH = 0.8, 0.6
# Forward and across view angles, degrees, in two strips.
LOOKS = ((1.0, -4.0), (20.0, -4.0), (-20.0, -4.0), (0.0, 12.0), (22.0, 13.0), (-22.0, 13.0))
NOISY = Optics(noise=0.02, noise_floor=22.0)
HEIGHTS, SEEN_M = (0.0, 100.0), 24.0
NMAD_M, BIAS_M, WITHIN_M, WITHIN = 0.12, 0.05, 0.5, 0.99


@pytest.fixture(scope="module")
def hillside(tmp_path_factory):
    """Six noisy images of a tilted plane."""
    folder = tmp_path_factory.mktemp("hillside")
    flat = analytic_ground("plane", CENTRE, GSD_M / 2, FIELD, seed=5)
    row, col = np.indices(FIELD)
    x, y = (col + 0.5 - FIELD[1] / 2) * flat.step, (FIELD[0] / 2 - row - 0.5) * flat.step
    slopes = np.broadcast_to((EAST * flat.step, -NORTH * flat.step), (*FIELD, 2))
    planes = np.concatenate([(50.0 + EAST * x + NORTH * y)[..., None], slopes], axis=-1).astype(np.float32)
    ground, paths = replace(flat, planes=planes), []
    for index, (along, across) in enumerate(LOOKS):
        centre = ((SIZE_PX - 1) / 2, (SIZE_PX - 1) / 2)
        sensor = SatelliteCamera((*CENTRE, 50.0), centre, GSD_M, along, across, 3.0)
        radiance = render(ground, sensor, (SIZE_PX, SIZE_PX), Sun(190.0, 50.0))
        paths.append(folder / f"view{index}.tif")
        rpc = fit_rpc(sensor, (SIZE_PX, SIZE_PX), UTM, (0.0, 120.0)).rpc
        write_image(paths[-1], expose(radiance, NOISY, np.random.default_rng([3, index])), rpc)
    return tuple(paths)


def errors_on(hillside, out):
    """Height errors (r, c) m in the middle of the images."""
    bounds = (CENTRE[0] - SEEN_M, CENTRE[1] - SEEN_M, CENTRE[0] + SEEN_M, CENTRE[1] + SEEN_M)
    height, source = read(run(hillside, out, heights=HEIGHTS, bounds=bounds).out / "dsm.tif")
    x, y = source.transform * np.meshgrid(np.arange(source.width) + 0.5, np.arange(source.height) + 0.5)
    return height - (50.0 + EAST * (x - CENTRE[0]) + NORTH * (y - CENTRE[1]))


def nmad(error):
    known = error[np.isfinite(error)]
    return 1.4826 * np.median(np.abs(known - np.median(known)))


def test_heights_of_a_hillside(hillside, tmp_path):
    error = errors_on(hillside, tmp_path / "out")
    assert nmad(error) < NMAD_M
    assert abs(np.nanmedian(error)) < BIAS_M
    assert (np.abs(error) < WITHIN_M).mean() > WITHIN  # An empty cell counts as wrong.


def test_a_flat_support_surface_makes_stairs(hillside, tmp_path, monkeypatch):
    """Without the slanted support surface the same bar is missed, because heights jump between whole steps; planes,
    which would smooth the stairs, are left out."""
    monkeypatch.setattr(finest_level, "SIDES", ())
    monkeypatch.setattr(
        SlopeSurface, "from_surface", lambda surface, block, _=None: SlopeSurface.flat(surface.shape, block)
    )
    error = errors_on(hillside, tmp_path / "out")
    assert (np.abs(error) < WITHIN_M).mean() < WITHIN
