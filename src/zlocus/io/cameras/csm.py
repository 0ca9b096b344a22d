"""Read line scanner states of the USGS Community Sensor Model, as usgscsm and Ames Stereo Pipeline write them (JSON).

Of `USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL`, positions, quaternions, line times, detector geometry and radial distortion
are read. Adjusted parameters other than zero, other distortions and other bodies than the Earth are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from zlocus.core.errors import InputError
from zlocus.core.sensor_model import FloatArray
from zlocus.io.cameras.camera_entry import Vector
from zlocus.io.cameras.linescan import LineScanCamera, RegularTimes
from zlocus.io.cameras.linescan_files import MAX_DETECTORS, write_calibration, write_times, write_trajectory
from zlocus.io.open_raster import existing_file
from zlocus.io.safe_documents import read_json
from zlocus.io.schema import FiniteNumber, StrictModel, WholeNumber, validate_document
from zlocus.sensors.earth_frame import MAJOR_M, MINOR_M
from zlocus.sensors.linescan import FocalLine, LineTimes
from zlocus.sensors.trajectory import Trajectory

# Times farther from the samples of a state than so many samples count as this far: such a state is refused later.
FARTHEST_SAMPLE = 1e6
MODEL = "USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"
RADIAL = 0
MAX_AXIS_DIFFERENCE_M = 100.0
# Numbers of samples of the converted trajectory. They are doubled until splines are this close to the polynomials of
# the state.
SAMPLE_COUNTS = (256, 512, 1024, 2048, 4096, 8192, 16384)
TOLERANCE_PX = 1e-3
# The trajectory goes beyond the first and the last row by this share of the exposure time of the image.
TIME_MARGIN = 0.1
REGULAR_TOLERANCE_ROWS = 1e-6
# Twice as many rows would take 500 MB.
MAX_ROWS = 4_000_000


class CsmState(StrictModel):
    """The fields of a state that are read. For their meaning see UsgsAstroLsSensorModel in usgscsm."""

    m_modelName: str
    m_nLines: WholeNumber = Field(gt=1, le=MAX_ROWS)
    m_nSamples: WholeNumber = Field(gt=1, le=MAX_DETECTORS)
    m_platformFlag: WholeNumber = 1
    m_intTimeLines: tuple[FiniteNumber, ...] = Field(min_length=1)
    m_intTimeStartTimes: tuple[FiniteNumber, ...]
    m_intTimes: tuple[FiniteNumber, ...]
    m_detectorSampleSumming: FiniteNumber = 1.0
    m_startingDetectorSample: FiniteNumber = 0.0
    m_startingDetectorLine: FiniteNumber = 0.0
    m_detectorSampleOrigin: FiniteNumber
    m_detectorLineOrigin: FiniteNumber
    m_iTransS: Vector
    m_iTransL: Vector
    m_focalLength: FiniteNumber = Field(gt=0)
    m_zDirection: Literal[1, -1]
    m_distortionType: WholeNumber
    m_opticalDistCoeffs: tuple[FiniteNumber, ...]
    m_majorAxis: FiniteNumber
    m_minorAxis: FiniteNumber
    m_t0Ephem: FiniteNumber
    m_dtEphem: FiniteNumber = Field(gt=0)
    m_positions: tuple[FiniteNumber, ...] = Field(min_length=6)
    m_t0Quat: FiniteNumber
    m_dtQuat: FiniteNumber = Field(gt=0)
    m_quaternions: tuple[FiniteNumber, ...] = Field(min_length=8)
    m_currentParameterValue: tuple[FiniteNumber, ...] = ()

    @field_validator("m_zDirection", mode="before")
    @classmethod
    def _whole(cls, value: object) -> object:
        return int(value) if isinstance(value, float) and value.is_integer() else value

    @model_validator(mode="after")
    def _supported(self) -> CsmState:
        if self.m_modelName != MODEL:
            raise ValueError(f"m_modelName is {self.m_modelName!r}; only {MODEL} is read")
        if (
            abs(self.m_majorAxis - MAJOR_M) > MAX_AXIS_DIFFERENCE_M
            or abs(self.m_minorAxis - MINOR_M) > MAX_AXIS_DIFFERENCE_M
        ):
            raise ValueError("m_majorAxis and m_minorAxis are not the Earth's in metres; other bodies are not read")
        coefficients = self.m_opticalDistCoeffs
        if any(coefficients) and (self.m_distortionType != RADIAL or len(coefficients) != 3):
            raise ValueError("m_distortionType is not 0 (radial, three m_opticalDistCoeffs); undistort the image first")
        if any(self.m_currentParameterValue):
            raise ValueError("m_currentParameterValue is not zero; apply the adjustment to the state (jitter_solve)")
        if not len(self.m_intTimeLines) == len(self.m_intTimeStartTimes) == len(self.m_intTimes):
            raise ValueError("m_intTimeLines, m_intTimeStartTimes and m_intTimes are not of the same length")
        if len(self.m_positions) % 3 or len(self.m_quaternions) % 4:
            raise ValueError("m_positions are not triples, or m_quaternions not quadruples")
        if not np.linalg.norm(np.reshape(self.m_quaternions, (-1, 4)), axis=1).min() > 0:
            raise ValueError("m_quaternions holds one of length 0")
        if self.m_iTransL[1] * self.m_iTransS[2] == self.m_iTransL[2] * self.m_iTransS[1]:
            raise ValueError("m_iTransL and m_iTransS are parallel, so that no place in the focal plane follows")
        return self


@dataclass(frozen=True, eq=False)
class CsmLineScanner:
    """The camera of a state, in geocentric axes. shape : rows and columns of its image."""

    line: FocalLine
    lines: LineTimes
    trajectory: Trajectory
    shape: tuple[int, int]


def read_csm(path: Path) -> CsmLineScanner:
    """The line scanner of a state.

    Raises
    ------
    InputError
        The file is no such state, or holds something that is not supported (see the module).
    """
    state = _state(existing_file(path, "camera file"))
    lines = _line_times(state, path)
    xy = _focal_plane(state)
    flipped, toward = _toward_the_ground(state, xy, float(lines.time(np.array([state.m_nLines / 2]))[0]))
    line = FocalLine(xy * flipped, state.m_focalLength)
    if not line.goes_on():
        raise InputError(f"{path}: the detectors of the state do not lie along a line. Get it from its source again.")
    return CsmLineScanner(line, lines, _sampled(state, lines, toward, line, path), (state.m_nLines, state.m_nSamples))


def convert_csm(path: Path, folder: Path, name: str) -> LineScanCamera:
    """Write a state as line scanner files NAME_*.csv into a folder, and return the `camera` entry for a scene file
    there.

    Raises
    ------
    InputError
        See `read_csm`.
    OutputError
        A file cannot be written.
    """
    scanner = read_csm(path)
    calibration, trajectory, times_name = (f"{name}_{what}.csv" for what in ("focal_plane", "trajectory", "times"))
    write_calibration(folder / calibration, {name: scanner.line}, f"from {path.name}")
    write_trajectory(folder / trajectory, scanner.trajectory, "s; m, geocentric; camera to geocentric", True)
    times: RegularTimes | str = times_name
    if len(scanner.lines.rows) == 2:
        times = RegularTimes(start=float(scanner.lines.times[0]), interval=scanner.lines.interval)
    else:
        write_times(folder / times_name, scanner.lines, "row of the image; s")
    return LineScanCamera(
        calibration=calibration, line=name, focal_mm=scanner.line.focal_mm, trajectory=trajectory, crs="EPSG:4978",
        times=times,
    )  # fmt: skip


def _state(path: Path) -> CsmState:
    """The state in a file. The name of the model may stand before the document."""
    document = read_json(path, start="{")
    if not isinstance(document, dict):
        raise InputError(f"{path} is not a CSM model state: it must hold m_modelName: {MODEL}.")
    return validate_document(CsmState, {key: document[key] for key in CsmState.model_fields if key in document}, path)


def _line_times(state: CsmState, path: Path) -> LineTimes:
    """Exposure times of the middles of rows, which is line 0.5 of CSM for row 0."""
    rows = np.arange(state.m_nLines, dtype=np.float64)
    line = rows + 0.5
    starts, times, durations = (
        np.array(v) for v in (state.m_intTimeLines, state.m_intTimeStartTimes, state.m_intTimes)
    )
    piece = np.maximum(np.searchsorted(starts, line, side="right") - 1, 0)
    when = times[piece] + durations[piece] * (line - starts[piece] + 0.5)
    steps = np.diff(when)
    if not (np.diff(starts) > 0).all() or not ((steps > 0).all() or (steps < 0).all()):
        raise InputError(f"{path}: the line times of the state do not run on. Get it from its source again.")
    straight = np.interp(rows, rows[[0, -1]], when[[0, -1]])
    if np.abs(when - straight).max() < REGULAR_TOLERANCE_ROWS * np.abs(steps).mean():
        return LineTimes(rows[[0, -1]], when[[0, -1]])
    return LineTimes(rows, when)


def _focal_plane(state: CsmState) -> FloatArray:
    """Undistorted positions of all columns in the focal plane (c, 2), in the units of the focal length.

    CSM counts samples from the outer corner of the first pixel, so its centre is 0.5.
    """
    sample = np.arange(state.m_nSamples) + 0.5
    across = sample * state.m_detectorSampleSumming + state.m_startingDetectorSample - state.m_detectorSampleOrigin
    along = state.m_startingDetectorLine - state.m_detectorLineOrigin
    matrix = np.array([state.m_iTransL[1:], state.m_iTransS[1:]])
    offset = np.stack([np.full(len(sample), along - state.m_iTransL[0]), across - state.m_iTransS[0]])
    xy = np.linalg.solve(matrix, offset).T
    if any(state.m_opticalDistCoeffs):
        k0, k1, k2 = state.m_opticalDistCoeffs
        squared = (xy**2).sum(axis=1, keepdims=True)
        xy = xy * (1.0 - (k0 + squared * (k1 + squared * k2)))
    return xy


def _toward_the_ground(state: CsmState, xy: FloatArray, time: float) -> tuple[FloatArray, FloatArray]:
    """Signs of x and y (2,), and of the camera's axes (3,), with which lines of sight (x, y, -focal) point to the
    ground.

    A line of sight of the state has no direction: (z x, z y, focal), with z the m_zDirection, may also mean its
    opposite.
    """
    at = np.array([time])
    sight = np.append(state.m_zDirection * xy[len(xy) // 2], state.m_focalLength)
    outwards = float((_rotations(state, at)[0] @ sight) @ _positions(state, at)[0])
    z = state.m_zDirection
    if outwards < 0:
        return np.array([z, -z]), np.array([1.0, -1.0, -1.0])
    return np.array([-z, -z]), np.ones(3)


def _sampled(state: CsmState, lines: LineTimes, toward: FloatArray, line: FocalLine, path: Path) -> Trajectory:
    """The trajectory around the image, sampled so densely that splines follow the interpolation of the state."""
    first, last = np.sort(lines.times[[0, -1]])
    known = [
        max(state.m_t0Ephem, state.m_t0Quat),
        min(
            state.m_t0Ephem + state.m_dtEphem * (len(state.m_positions) // 3 - 1),
            state.m_t0Quat + state.m_dtQuat * (len(state.m_quaternions) // 4 - 1),
        ),
    ]
    if first < known[0] or last > known[1]:
        raise InputError(
            f"{path}: rows were exposed from {first:.6f} to {last:.6f} s, but positions and quaternions are known from "
            f"{known[0]:.6f} to {known[1]:.6f} s only. Get a state that covers the image."
        )
    beyond = TIME_MARGIN * (last - first)
    start, end = max(first - beyond, known[0]), min(last + beyond, known[1])
    pixel = np.linalg.norm(line.xy_mm[-1] - line.xy_mm[0]) / (len(line.xy_mm) - 1)
    height = np.linalg.norm(_positions(state, np.array([first]))) - MAJOR_M
    for n in SAMPLE_COUNTS:
        trajectory = _poses(state, np.linspace(start, end, n), toward)
        middle = (trajectory.times[1:] + trajectory.times[:-1]) / 2
        off = np.abs(trajectory.pose(middle) - _poses(state, middle, toward).pose(middle)).max(axis=1)
        if max(off[:9].max(), off[9:].max() / height) * line.focal_mm / pixel < TOLERANCE_PX:
            return trajectory
    raise InputError(f"{path}: positions or quaternions change too fast from sample to sample. Smooth them.")


def _poses(state: CsmState, times: FloatArray, toward: FloatArray) -> Trajectory:
    geocentric_from_camera = _rotations(state, times) * toward
    return Trajectory(times, _positions(state, times), np.ascontiguousarray(geocentric_from_camera.swapaxes(-1, -2)))


def _rotations(state: CsmState, times: FloatArray) -> FloatArray:
    """Rotations from the camera's axes to geocentric axes at instants (n,) s: (n, 3, 3)."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(_quaternions(state, times)).as_matrix()


def _positions(state: CsmState, times: FloatArray) -> FloatArray:
    order = 8 if state.m_platformFlag else 4
    return lagrange_interpolated(np.reshape(state.m_positions, (-1, 3)), state.m_t0Ephem, state.m_dtEphem, times, order)


def _quaternions(state: CsmState, times: FloatArray) -> FloatArray:
    # usgscsm compares the count of numbers, not of quaternions, with 8, so the order is lower only for one quaternion.
    order = 8 if state.m_platformFlag else 4
    return lagrange_interpolated(np.reshape(state.m_quaternions, (-1, 4)), state.m_t0Quat, state.m_dtQuat, times, order)


def lagrange_interpolated(values: FloatArray, start: float, step: float, times: FloatArray, order: int) -> FloatArray:
    """Values (n, v) at times (n,), interpolated by polynomials between values (k, v) at evenly spaced times.

    A polynomial passes through the `order` nearest samples, through fewer near the ends (6, 4, 2), as in lagrangeInterp
    of usgscsm.
    """
    with np.errstate(over="ignore"):
        at = np.clip((times - start) / step, -FARTHEST_SAMPLE, FARTHEST_SAMPLE)
    index = np.clip(at.astype(int), 0, len(values) - 2)
    room = np.minimum(np.minimum(2 * (index + 1), 2 * (len(values) - 1 - index)), order)
    out = np.empty((len(times), values.shape[1]))
    for count in np.unique(room):
        chosen = room == count
        nodes = np.arange(count) - count // 2 + 1
        since = (at - index)[chosen, None] - nodes
        weights = np.empty_like(since)
        for j, node in enumerate(nodes):
            others = np.delete(np.arange(count), j)
            weights[:, j] = np.prod(since[:, others] / (node - nodes[others]), axis=1)
        out[chosen] = np.einsum("nk,nkv->nv", weights, values[index[chosen, None] + nodes])
    return out
