"""Row of the acceptance table on the self-calibration of a drone's camera, from images whose camera is known exactly.

The blocks are rendered with a lens with distortion and with a rolling shutter, and their scene files state neither. As
users would do, `zlocus orient` is asked for k1, k2 and the read-out time, with the errors of the poses and a guess of
how wrong the camera may be as standard deviations beforehand.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rows.drone_block import provide_block
from workplace import ZLOCUS, Figure, Workplace, run
from zlocus.io.scene_file import open_scene
from zlocus.sensors.distortion import BrownDistortion
from zlocus.sensors.frame import FrameModel
from zlocus.synthetic.drone_block import DroneBlockSpec

SEEDS = (1, 2, 3)
# Errors of the stated poses, as of a drone with corrections in real time and a gimbal.
POSITION_M, ATTITUDE_DEG = 0.05, 0.1
# A lens that moves the corners by 100 px, as that of a drone that does not correct its images, and a shutter in whose
# read-out the image moves by 3 px.
BLOCK = DroneBlockSpec(
    columns=1200, rows=900, focal_px=900.0, strips=2, frames_per_strip=2, crossing_strips=2, crossing_tilt_deg=20.0,
    step_m=0.1, samples=1, n_targets=0, position_error_m=POSITION_M, angle_error_deg=ATTITUDE_DEG,
    distortion=BrownDistortion(k1=-0.26, k2=0.10), stated_distortion=BrownDistortion(),
    readout_s=0.030, stated_readout_s=0.0,
)  # fmt: skip
# Level ground with nothing on it but kerbs and hedges, and level cameras at one height, of which a focal length is
# stated that is 1 % too long.
FLAT_BLOCK = replace(
    BLOCK, crossing_strips=0, frames_per_strip=3, relief_m=0.1, houses_per_ha=0.0, trees_per_ha=0.0, cars_per_ha=0.0,
    least_tilt_deg=0.0, largest_tilt_deg=0.0, flight_noise_m=0.0, stated_distortion=None, readout_s=0.0,
    stated_readout_s=None, stated_focal_px=909.0,
)  # fmt: skip
PARAMETERS = {"k1": "k1", "k2": "k2", "readout_ms": "read-out time"}
# Standard deviations beforehand of what is calibrated.
GUESSED = {"sigma_distortion_px": 100.0, "sigma_readout_ms": 30.0}
MOST_SIGMAS = 3.0
SCALED_FAULT = "an estimate is biased, or its standard deviation leaves errors out that all ties have in common"


@dataclass(frozen=True)
class Oriented:
    """A block that was oriented. folder : of the results; report : its `orientation.json`; said : by the command."""

    folder: Path
    report: dict[str, Any]
    said: str

    def correction(self, name: str) -> dict[str, Any]:
        """The entry of the report on a parameter of the self-calibration."""
        return next(each for each in self.report["corrections"] if name in each["added"])

    @property
    def residual_px(self) -> float:
        """Root mean square of the residuals of the image points of ties, px."""
        return float(self.report["sensors"]["frame"]["residual_after_px"]["rms"])

    @property
    def n_image_points(self) -> int:
        """Number of image points of ties."""
        return int(self.report["sensors"]["frame"]["n_ties"])


def self_calibration(
    workplace: Workplace,
    spec: DroneBlockSpec = BLOCK,
    flat: DroneBlockSpec = FLAT_BLOCK,
    seeds: tuple[int, ...] = SEEDS,
) -> list[Figure]:
    """What a self-calibration finds of a planted lens and shutter, and whether a flat block holds the focal length.

    spec, flat : blocks with and without relief and oblique images; seeds : of the first one, its ground, flight and
    noise. Of the seeds, the worst value is given.
    """
    workplace.inputs["seeds"] = list(seeds)
    without, calibrated = [], []
    for seed in seeds:
        scene = workplace.out / f"block-{seed}"
        provide_block(replace(spec, seed=seed), scene)
        without.append(oriented(workplace, scene, "without", ()))
        calibrated.append(oriented(workplace, scene, "calibrated", ("k1", "k2", "readout"), **GUESSED))
    scene = workplace.out / "block-flat"
    provide_block(flat, scene)
    is_held = says_that_the_focal_length_is_held(scene, oriented(workplace, scene, "calibrated", ("focal",)))
    return [
        *estimates(planted_values(spec), calibrated),
        Figure("residuals, without", max(each.residual_px for each in without), "px"),
        Figure("residuals, self-calibration", max(each.residual_px for each in calibrated), "px"),
        Figure("image points of ties, without", min(each.n_image_points for each in without)),
        Figure("image points of ties, self-calibration", min(each.n_image_points for each in calibrated)),
        Figure(
            "flat block, focal length held and said so", float(is_held), at_least=1.0,
            fails_when="the focal length is corrected although the flying height explains it, or nothing says so",
        ),
    ]  # fmt: skip


def oriented(workplace: Workplace, scene: Path, name: str, parameters: tuple[str, ...], **sigmas: float) -> Oriented:
    """A block after `zlocus orient`. parameters : of the self-calibration; sigmas : more options of the adjustment."""
    out = workplace.out / f"{scene.name}-{name}"
    options = {"sigma_position_m": POSITION_M, "sigma_attitude_deg": ATTITUDE_DEG, **sigmas}
    lines = [f"self_calibration = {json.dumps(parameters)}", *(f"{key} = {value}" for key, value in options.items())]
    config = out.with_suffix(".toml")
    config.parent.mkdir(parents=True, exist_ok=True)
    config.write_text("\n".join(["[orientation.bundle_adjustment]", *lines, ""]), encoding="utf-8")
    used = run([ZLOCUS, "orient", scene / "scene.yaml", "-o", out, "--config", config, "--overwrite"])
    report = json.loads((out / "orientation.json").read_text(encoding="utf-8"))
    return Oriented(out, report, used.said)


def planted_values(spec: DroneBlockSpec) -> dict[str, float]:
    """What has to be added to the camera that is stated, by name of the parameter."""
    true, stated = spec.distortion, spec.stated_distortion
    assert isinstance(true, BrownDistortion), "the rendered lens"
    assert isinstance(stated, BrownDistortion), "the stated lens"
    assert spec.stated_readout_s is not None, "the stated shutter"
    readout_ms = 1000.0 * (spec.readout_s - spec.stated_readout_s)
    return {"k1": true.k1 - stated.k1, "k2": true.k2 - stated.k2, "readout_ms": readout_ms}


def estimates(planted: dict[str, float], calibrated: list[Oriented]) -> list[Figure]:
    """Errors by the standard deviations that the reports state, and these by the planted values; of all seeds the
    largest. NaN where a parameter is held, which has no standard deviation."""
    figures = []
    for name, words in PARAMETERS.items():
        corrections = [each.correction(name) for each in calibrated]
        found = np.array([each["added"][name] for each in corrections])
        sigmas = np.array([each["sigma_after"][name] for each in corrections], float)
        scaled = np.abs(found - planted[name]) / sigmas
        figures += [
            Figure(
                f"{words}: error by stated sigma, largest", float(scaled.max()), at_most=MOST_SIGMAS,
                fails_when=SCALED_FAULT,
            ),
            Figure(f"{words}: stated sigma by planted value, largest", float((sigmas / abs(planted[name])).max())),
        ]  # fmt: skip
    return figures


def says_that_the_focal_length_is_held(scene: Path, found: Oriented) -> bool:
    """Whether all cameras keep the focal length that the scene states, and both the report and the log say why."""
    stated, written = (focal_lengths(folder / "scene.yaml") for folder in (scene, found.folder))
    reason = found.correction("focal_px").get("held_because", {}).get("focal_px", "")
    return stated == written and "focal length" in reason and "is held" in reason and reason in found.said


def focal_lengths(scene: Path) -> set[float]:
    """The focal lengths of all cameras of a scene file, px."""
    return {view.sensor.focal for view in open_scene([scene]).views if isinstance(view.sensor, FrameModel)}
