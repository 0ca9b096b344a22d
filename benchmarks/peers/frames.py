"""Scenes of the comparison from frame cameras: rendered blocks of aerial images with exact truth.

The cameras are perspective, with the lens of a consumer drone, and exact. Programs that know RPC only leave these
scenes out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio

from peers.scenes import RANGE_MARGIN_M, Scene, write_terrain
from zlocus.synthetic.drone_block import DroneBlockSpec, drone_block_files, render_drone_block

FRAME = "frames"
# Ground pixel, m, and cell of the truth, m.
GROUND_PIXEL_M, TRUTH_M = 0.3, 0.25
# Rows and focal length by the columns of a frame.
ROWS, FOCAL = 0.75, 0.85
# Programs that are given scenes of frame cameras. OpenCV and Pandora have no cameras: the comparison has them.
TAKE_FRAMES = ("zlocus", "OpenCV SGBM", "Pandora")


def takes_frames(program: str) -> bool:
    """Whether a program is run on scenes of frame cameras."""
    return program in TAKE_FRAMES


@dataclass(frozen=True)
class FrameBlock:
    """A block that `zlocus.synthetic` renders: parallel strips over a settlement with trees. columns : of a frame."""

    seed: int
    strips: int
    frames_per_strip: int
    columns: int = 1000

    @property
    def spec(self) -> DroneBlockSpec:
        """What is rendered: frames overlap by 60 % along and across the strips."""
        focal_px = FOCAL * self.columns
        return DroneBlockSpec(
            seed=self.seed, columns=self.columns, rows=round(ROWS * self.columns), strips=self.strips,
            frames_per_strip=self.frames_per_strip, focal_px=focal_px, flying_height_m=GROUND_PIXEL_M * focal_px,
            step_m=TRUTH_M, n_targets=0,
        )  # fmt: skip

    def scene(self, name: str, folder: Path) -> Scene:
        """The scene with all frames, rendered into a folder if that is not done yet."""
        where = folder / f"{FRAME}-{self.seed}-{self.columns}-{self.strips}-{self.frames_per_strip}"
        if not where.exists():
            folder.mkdir(parents=True, exist_ok=True)
            render_drone_block(self.spec, where)
        block = drone_block_files(self.spec, where)
        with rasterio.open(block.truth_dsm) as file:
            heights, crs, bounds = file.read(1), file.crs.to_string(), tuple(file.bounds)
            terrain = write_terrain(heights, file.transform, crs, where / "terrain.tif")
        reach = float(np.nanmin(heights)) - RANGE_MARGIN_M, float(np.nanmax(heights)) + RANGE_MARGIN_M
        return Scene(
            f"{name}, {len(block.images)} views", FRAME, block.images, crs, bounds, reach, terrain, block.truth_dsm,
            block.truth_class, cameras=block.scene,
        )  # fmt: skip


# Two strips of three frames, of which all show the middle, and two strips of two.
FRAMES = {"aerial frames": FrameBlock(211, 2, 3), "aerial frames of two strips": FrameBlock(212, 2, 2)}
