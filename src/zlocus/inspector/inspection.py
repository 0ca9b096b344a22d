"""The surface that the page shows: what is known of it at once, and what is prepared in the background."""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, TypeVar

from zlocus.core.errors import ConfigError, GeometryError, InputError, ZlocusError
from zlocus.core.options import RunConfig, SelectionOptions, large_window_side
from zlocus.core.parallel import submitted
from zlocus.evaluation.comparison import Comparison
from zlocus.inspector.cell import WhatIf, cell_record, match_record
from zlocus.inspector.folder import SurfaceFolder, surface_folder
from zlocus.inspector.layers import Layer, difference_layer, extent_of, layers_of
from zlocus.inspector.matcher_account import MatchedPart, matched_part, matcher_record, part_of
from zlocus.inspector.queries import KINDS, MAX_VALUES, WINDOWS
from zlocus.inspector.reference import Reference, check_comparison, reference_for
from zlocus.inspector.restored_run import Restored, restored
from zlocus.io.run_record import read_record
from zlocus.pipeline.recorded_run import config_of
from zlocus.pipeline.report_inputs import said
from zlocus.products.report.file_names import CURVES, RECORD
from zlocus.products.report.page import KIND_WORDS

T = TypeVar("T")
MIN_LEVEL_CELLS = 128
# A first match, which compiles the kernels, is tried at this many tie points.
WARM_UP_PLACES = 8
NOT_THE_SAME = (
    "Cameras or grey values differ from those of the run: an image has changed since, or this is another machine. "
    "Match curves may differ from those of the run."
)
NOT_KNOWN = "The run did not record its fingerprint, so it is not known whether the cameras are the same as in the run."
MADE_AGAIN = "The surface was made again, or removed, after this page was opened. Start `zlocus inspect` again."
# Options that have no effect on a single cell.
OPTIONS_OF_RUNS = ("stopped_share",)


@dataclass
class OpeningProgress:
    """Latest progress of the opening of a scene, as a text; a `Progress`."""

    text: str = ""
    _name: str = ""
    _total: float | None = None
    _done: float = 0.0

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[OpeningProgress]:
        """See `Progress`."""
        self.text, self._name, self._total, self._done = name, name, total, 0.0
        yield self

    def note(self, sentence: str) -> None:
        """See `Progress`."""

    def advance(self, n: float = 1) -> None:
        """See `Stage`."""
        self._done += n
        if self._total:
            self.text = f"{self._name}, {min(self._done / self._total, 1):.0%}"

    def tell(self, text: str) -> None:
        """See `Stage`."""


class Inspection:
    """A surface, its scene and its comparison with a reference; the latter two are prepared in the background.

    The preparation starts when the context is entered. Temporary files are removed when it ends.

    comparison : with a reference, or None; may_read_remote : whether images on a server may be read.

    Raises
    ------
    InputError
        There is no complete surface in the folder, or the reference is missing.
    """

    def __init__(self, out: Path, comparison: Comparison | None = None, may_read_remote: bool = False) -> None:
        self.folder: SurfaceFolder = surface_folder(out)
        self._state = self._now()
        if comparison is not None:
            check_comparison(comparison)
        self._may_read_remote, self._opening_progress = may_read_remote, OpeningProgress()
        self.layers: dict[str, Layer] = layers_of(self.folder)
        self.comparison = comparison
        self._scene: Future[Restored] = Future()
        self._reference: Future[Reference] | None = None
        self._stack = ExitStack()
        # One match at a time, because each uses the whole machine.
        self._matching = threading.Lock()
        # What the matcher weighed takes seconds, for which clicks do not wait.
        self._weighing = threading.Lock()
        self._matched_part: MatchedPart | None = None

    def __enter__(self) -> Inspection:
        scratch = TemporaryDirectory(prefix="zlocus-inspect-", ignore_cleanup_errors=True)
        self._stack.enter_context(scratch)
        threads = ThreadPoolExecutor(2, "inspect")
        # An interruption does not wait until the scene is open, see `zlocus.core.parallel.is_busy`.
        self._stack.callback(threads.shutdown, wait=False, cancel_futures=True)
        self._scene = submitted(threads, self._open)
        if self.comparison is not None:
            self._reference = submitted(threads, self._compare, self.comparison, Path(scratch.name))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()

    def _open(self) -> Restored:
        found = restored(self.folder.out, self.folder.run, self._may_read_remote, self._opening_progress)
        # Compile or load the kernels before a user waits for them.
        for xy in found.run.ties[:: len(found.run.ties) // WARM_UP_PLACES + 1, :2]:
            try:
                if "match" in match_record(self.folder, found, xy, math.nan, WhatIf()):
                    break
            except Exception:
                continue  # Too few images show this place; any other one will do.
        return found

    def _compare(self, comparison: Comparison, scratch: Path) -> Reference:
        return reference_for(self.folder.path("dsm"), comparison, scratch)

    @property
    def reference(self) -> Reference | None:
        """The reference, once it is ready; None before, and without one."""
        return _done(self._reference)

    def layer(self, name: str) -> Layer | None:
        """A layer by its name; None where it does not exist, or does not exist yet."""
        if name == "difference" and (reference := self.reference) is not None:
            return difference_layer(self.folder, reference)
        return self.layers.get(name)

    def state(self) -> dict[str, Any]:
        """State of scene and reference: "opening", "ready" or "failed" with the reason; and notes for the user."""
        state: dict[str, Any] = {"scene": _progress(self._scene), "notes": []}
        if self._reference is not None:
            state["reference"] = _progress(self._reference)
        scene, reference = _done(self._scene), self.reference
        if state["scene"]["is"] == "opening":
            state["scene"]["what"] = self._opening_progress.text
        if scene is not None and not scene.is_same:
            state["notes"].append(NOT_KNOWN if scene.is_same is None else NOT_THE_SAME)
        if self._now() != self._state:
            state["notes"].append(MADE_AGAIN)
        if reference is not None:
            layer = difference_layer(self.folder, reference)
            state["comparison"] = reference.sentence
            state["difference"] = {"name": layer.name, "title": layer.title, "legend": layer.legend}
        return state

    def cell(self, x: float, y: float, what_if: WhatIf) -> dict[str, Any]:
        """Record of the cell at a ground point, m; with its match as soon as the scene is open.

        Raises
        ------
        GeometryError
            The point lies outside the grid.
        ConfigError
            See `WhatIf`.
        """
        at = self.folder.cell_of(x, y)
        if at is None:
            raise GeometryError("The point lies outside the surface.")
        record = cell_record(self.folder, self.reference, *at)
        if not self._scene.done():
            return record | {"is_pending": True}
        if (error := _failure(self._scene)) is not None:
            return record | {"error": said(error)}
        xy = self.folder.centre_of(*at)
        try:
            with self._matching:
                return record | match_record(self.folder, self._scene.result(), xy, record["height_m"], what_if)
        except (GeometryError, InputError) as error:
            return record | {"error": str(error)}

    def matcher(self, x: float, y: float) -> dict[str, Any]:
        """What the matcher weighed at the cell at a ground point, m; see `matcher_record`.

        The part of the run's tile that was matched again last is kept, so that the next cell in it is told at once.

        Raises
        ------
        GeometryError
            The point lies outside the grid, or no two images see it.
        ConfigError
            The scene is not open, or the run weighed no costs of cells.
        """
        at = self.folder.cell_of(x, y)
        if at is None:
            raise GeometryError("The point lies outside the surface.")
        scene = _done(self._scene)
        if scene is None:
            raise ConfigError("The images are not open, so nothing can be matched again.")
        xy = self.folder.centre_of(*at)
        with self._weighing:
            part = self._matched_part
            if part is None or part.core_window != part_of(scene, xy)[0]:
                self._matched_part = None  # its arrays are given back before the next ones are made
                part = self._matched_part = matched_part(self.folder, scene, xy)
            return matcher_record(scene, part, self.folder, xy)

    def check_unchanged(self) -> None:
        """Refuse requests after the surface has changed.

        Raises
        ------
        InputError
            The surface was made again, or removed.
        """
        if self._now() != self._state:
            raise InputError(MADE_AGAIN)

    def _now(self) -> tuple[int, int] | None:
        """Time and size of run.json, by which a change of the surface is noticed; None where it is missing."""
        try:
            status = (self.folder.out / RECORD).stat()
        except OSError:
            return None
        return status.st_mtime_ns, status.st_size

    def summary(self) -> dict[str, Any]:
        """What the page needs before it can show anything."""
        folder, run = self.folder, self.folder.run
        try:
            config = config_of(folder.out / RECORD, run)
        except ConfigError:
            config = RunConfig()  # The opening of the scene fails then, with the reason.
        rows, cols = folder.shape
        return {
            "title": folder.out.resolve().name, "shape": [rows, cols], "transform": list(folder.transform)[:6],
            "crs": "a local frame" if folder.is_local else folder.crs.name, "height_name": folder.height_name,
            "axes": ["x", "y"] if folder.is_local else ["E", "N"],
            "extent": list(extent_of(folder)), "has_terrain": folder.has("dtm"),
            "levels": max(math.ceil(math.log2(max(rows, cols) / MIN_LEVEL_CELLS)), 0),
            "layers": [
                {"name": layer.name, "title": layer.title, "legend": layer.legend} for layer in self.layers.values()
            ],
            "made": run.get("created", ""),
            "images": list(run["orientation"]["views"]), "method": run["config"]["request"]["method"],
            "small_window": config.cost.small_window,
            "max_images_for_large_window": config.cost.max_images_for_large_window,
            "selection": run["config"]["request"].get("selection", "default"),
            "options": options_record(config.selection),
            "window": {"value": large_window_side(config.cost), "choices": list(WINDOWS)},
            "cells": self._cells(),
        }  # fmt: skip

    def _cells(self) -> list[dict[str, Any]]:
        """The example cells of the report."""
        path = self.folder.out / CURVES
        if not path.exists():
            return []
        try:
            cells = read_record(path)["cells"]
            return [{"x": c["x"], "y": c["y"], "what": f"{KIND_WORDS[c['kind']]}: {c['why']}"} for c in cells]
        except (ZlocusError, KeyError, TypeError):
            return []


def options_record(selection: SelectionOptions) -> list[dict[str, Any]]:
    """Options of the selection as the page offers them."""
    return [
        {
            "name": f.name, "doc": f.metadata["doc"], "value": getattr(selection, f.name), "low": f.metadata["low"],
            "high": MAX_VALUES.get(f.name, f.metadata["high"]), "choices": f.metadata["choices"],
            "unit": f.metadata["unit"],
            "is_whole": KINDS[f.name] is int,
        }
        for f in fields(selection)
        if f.name not in OPTIONS_OF_RUNS
    ]  # fmt: skip


def _progress(future: Future[Any]) -> dict[str, Any]:
    if not future.done():
        return {"is": "opening"}
    error = _failure(future)
    return {"is": "ready"} if error is None else {"is": "failed", "why": said(error)}


def _failure(future: Future[Any]) -> Exception | None:
    """Error of a future that is done; None where it succeeded."""
    error = future.exception()
    return error if isinstance(error, Exception) else None


def _done(future: Future[T] | None) -> T | None:
    """Result of a future; None before it is done, and where it failed."""
    if future is None or not future.done() or future.exception() is not None:
        return None
    return future.result()
