"""The row of the self-calibration: planted values, errors by stated standard deviations, and what the log says."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from rows import self_calibration as row
from workplace import Figure, Usage, Workplace
from zlocus.sensors.distortion import BrownDistortion
from zlocus.synthetic.drone_block import DroneBlockSpec

SIGMAS = {"k1": 0.004, "k2": 0.006, "readout_ms": 2.0}
# Errors of the estimates of two seeds, by their standard deviations.
ERRORS = {1: {"k1": 0.5, "k2": -1.0, "readout_ms": 2.0}, 2: {"k1": -2.5, "k2": 0.4, "readout_ms": -3.5}}
REASON = "The focal length of 2 images (s1_1 to s1_2) is held: the tie points do not tell it from the flying height."


def small(spec: DroneBlockSpec) -> DroneBlockSpec:
    """Two frames of 160 x 120 px, with the cameras of a block of the row."""
    return replace(
        spec, columns=160, rows=120, focal_px=160.0, strips=1, frames_per_strip=2, crossing_strips=0, step_m=0.4,
        stated_focal_px=None if spec.stated_focal_px is None else 162.0,
    )  # fmt: skip


@pytest.fixture
def program(monkeypatch: pytest.MonkeyPatch) -> Program:
    """The row with a program that writes known results in place of `zlocus orient`."""
    found = Program()
    monkeypatch.setattr(row, "run", found.run)
    return found


class Program:
    """Writes the results of a self-calibration. Its attributes are what a fault would change."""

    def __init__(self) -> None:
        self.commands: list[list[object]] = []
        self.sigmas: dict[str, float | None] = dict(SIGMAS)
        self.said, self.reason, self.focal_factor = f"Tie points: done in 1.0 s\n{REASON}\n", REASON, 1.0

    def run(self, command: list[object]) -> Usage:
        self.commands.append(command)
        scene, out, config = Path(str(command[2])), Path(str(command[4])), Path(str(command[6]))
        options = tomllib.loads(config.read_text())["orientation"]["bundle_adjustment"]
        names = ["focal_px"] if options["self_calibration"] == ["focal"] else list(SIGMAS)
        report = {
            "corrections": [self.correction(name, scene.parent) for name in names if options["self_calibration"]],
            "sensors": {"frame": {"n_ties": 500, "residual_after_px": {"rms": 0.2 if names else 0.9}}},
        }
        out.mkdir(parents=True)
        (out / "orientation.json").write_text(json.dumps(report))
        written = scene.read_text().replace("focal: 162.0", f"focal: {162.0 * self.focal_factor}")
        (out / "scene.yaml").write_text(written.replace("image: ", f"image: {scene.parent}/"))
        return Usage(1.0, 0.5, said=self.said)

    def correction(self, name: str, scene: Path) -> dict[str, object]:
        """The entry of the report on a parameter."""
        if name == "focal_px":
            held = {"held_because": {name: self.reason}} if self.reason else {}
            return {"added": {name: 0.0}, "sigma_after": {name: None}} | held
        seed = json.loads((scene / "scene.json").read_text())["seed"]
        planted = {"k1": -0.26, "k2": 0.10, "readout_ms": 30.0}[name]
        return {"added": {name: planted + ERRORS[seed][name] * SIGMAS[name]}, "sigma_after": {name: self.sigmas[name]}}


def figures_of(folder: Path, seeds: tuple[int, ...] = (1, 2)) -> dict[str, Figure]:
    workplace = Workplace(None, folder)
    found = row.self_calibration(workplace, small(row.BLOCK), small(row.FLAT_BLOCK), seeds)
    assert workplace.inputs["seeds"] == list(seeds)
    assert all(figure.fails_when for figure in found if figure.bar)
    return {figure.what: figure for figure in found}


def test_errors_are_given_by_their_stated_sigmas(program: Program, tmp_path: Path) -> None:
    """Of each parameter that of the worst seed; an error of more than three sigmas misses the bar."""
    figures = figures_of(tmp_path)
    scaled = {name: figures[f"{words}: error by stated sigma, largest"] for name, words in row.PARAMETERS.items()}
    assert {name: figure.value for name, figure in scaled.items()} == {
        "k1": pytest.approx(2.5), "k2": pytest.approx(1.0), "readout_ms": pytest.approx(3.5),
    }  # fmt: skip
    assert [scaled[name].passes for name in ("k1", "k2", "readout_ms")] == [True, True, False]
    assert figures["k1: stated sigma by planted value, largest"].value == pytest.approx(0.004 / 0.26)
    assert figures["read-out time: stated sigma by planted value, largest"].value == pytest.approx(2.0 / 30.0)
    assert figures["flat block, focal length held and said so"].passes
    # Without and with self-calibration for each seed, then the flat block.
    assert [Path(str(command[4])).name for command in program.commands] == [
        "block-1-without", "block-1-calibrated", "block-2-without", "block-2-calibrated", "block-flat-calibrated",
    ]  # fmt: skip


def test_a_parameter_that_is_held_misses_its_bar(program: Program, tmp_path: Path) -> None:
    program.sigmas["k2"] = None
    figures = figures_of(tmp_path, (1,))
    held = figures["k2: error by stated sigma, largest"]
    assert math.isnan(held.value)
    assert not held.passes
    assert figures["k1: error by stated sigma, largest"].passes


@pytest.mark.parametrize("fault", [{"said": "Tie points: done\n"}, {"reason": ""}, {"focal_factor": 0.99}], ids=str)
def test_a_focal_length_that_is_changed_or_held_in_silence_misses_its_bar(
    program: Program, tmp_path: Path, fault: dict[str, object]
) -> None:
    for name, value in fault.items():
        setattr(program, name, value)
    figure = figures_of(tmp_path, (1,))["flat block, focal length held and said so"]
    assert figure.value == 0.0
    assert not figure.passes


def test_the_blocks_state_another_camera_than_the_one_that_renders_them() -> None:
    assert row.planted_values(row.BLOCK) == {"k1": -0.26, "k2": 0.10, "readout_ms": pytest.approx(30.0)}
    assert row.BLOCK.stated_distortion == BrownDistortion()
    assert row.FLAT_BLOCK.stated_focal_px != row.FLAT_BLOCK.focal_px
    tilts = row.FLAT_BLOCK.least_tilt_deg, row.FLAT_BLOCK.largest_tilt_deg, row.FLAT_BLOCK.crossing_strips
    assert tilts == (0.0, 0.0, 0)
