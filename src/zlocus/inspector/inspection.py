"""A surface that is being looked at: what is known of it at once, and what is made ready meanwhile."""

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
from zlocus.inspector.cell import WhatIf, cell_record, match_record
from zlocus.inspector.folder import SurfaceFolder, surface_folder
from zlocus.inspector.layers import Layer, difference_layer, layers_of
from zlocus.inspector.queries import KINDS, MOST, WINDOWS
from zlocus.inspector.reference import Reference, check_comparison, reference_for
from zlocus.inspector.restored_run import Restored, config_of, restored
from zlocus.io.run_record import read_record
from zlocus.pipeline.report_inputs import said
from zlocus.evaluation.comparison import Comparison
from zlocus.products.report.file_names import CURVES, RECORD
from zlocus.products.report.page import KIND_WORDS

T = TypeVar("T")
FEWEST_LEVEL_CELLS = 128
# Tie points at which a first match is tried.
WARM_PLACES = 8
NOT_THE_SAME = (
    "Cameras or grey values came out otherwise than in the run: an image has changed since, or this is another "
    "machine. Curves may differ from those that the surface rests on."
)
NOT_KNOWN = "The run did not keep what tells whether cameras come out again as they were."
MADE_AGAIN = "The surface was made again, or removed, since this page was opened. Start `zlocus inspect` anew."
# Options that nothing of a single cell depends on.
OF_RUNS = ("stopped_share", "min_images_for_choice")


@dataclass
class Told:
    """What the opening of a scene says last, as a `Progress`."""

    text: str = ""
    _name: str = ""
    _total: float | None = None
    _done: float = 0.0

    @contextmanager
    def stage(self, name: str, total: float | None = None) -> Iterator[Told]:
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
    """A surface and its scene, which is opened in the background, as is the comparison with a reference.

    As a context it opens the scene, and removes at the end what it keeps on disk.

    comparison : with a reference; may_ask : whether images on a server are asked for.

    Raises
    ------
    InputError
        There is no complete surface in the folder, or no reference.
    """

    def __init__(self, out: Path, comparison: Comparison | None = None, may_ask: bool = False) -> None:
        self.folder: SurfaceFolder = surface_folder(out)
        self._state = self._now()
        if comparison is not None:
            check_comparison(comparison)
        self._may_ask, self._told = may_ask, Told()
        self.layers: dict[str, Layer] = layers_of(self.folder)
        self.comparison = comparison
        self._scene: Future[Restored] = Future()
        self._reference: Future[Reference] | None = None
        self._stack = ExitStack()
        # One match at a time: each takes all that the machine has.
        self._matching = threading.Lock()

    def __enter__(self) -> Inspection:
        scratch = TemporaryDirectory(prefix="zlocus-inspect-", ignore_cleanup_errors=True)
        self._stack.enter_context(scratch)
        threads = ThreadPoolExecutor(2, "inspect")
        # Who interrupts does not wait for a scene to open, see `zlocus.core.parallel.is_busy`.
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
        found = restored(self.folder.out, self.folder.run, self._may_ask, self._told)
        # Kernels are compiled, or loaded, before anyone waits for them.
        for xy in found.run.ties[:: len(found.run.ties) // WARM_PLACES + 1, :2]:
            try:
                match_record(found, xy, math.nan, WhatIf())
                break
            except Exception:
                continue  # too few images there, or a place that is none: nothing depends on it
        return found

    def _compare(self, comparison: Comparison, scratch: Path) -> Reference:
        return reference_for(self.folder.path("dsm"), comparison, scratch)

    @property
    def reference(self) -> Reference | None:
        """What the surface is compared with, once it is ready."""
        return _done(self._reference)

    def layer(self, name: str) -> Layer | None:
        """A layer by its name, None of one that is not there, or not yet."""
        if name == "difference" and (reference := self.reference) is not None:
            return difference_layer(self.folder, reference)
        return self.layers.get(name)

    def state(self) -> dict[str, Any]:
        """How far what is made in the background is: of scene and reference "opening", "ready" or "failed", with the
        reason; notes : what is to be known of them."""
        state: dict[str, Any] = {"scene": _progress(self._scene), "notes": []}
        if self._reference is not None:
            state["reference"] = _progress(self._reference)
        scene, reference = _done(self._scene), self.reference
        if state["scene"]["is"] == "opening":
            state["scene"]["what"] = self._told.text
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
        """What is to be said of the cell at a ground point, m; of the match as soon as the scene is open.

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
        try:
            with self._matching:
                match = match_record(self._scene.result(), self.folder.middle_of(*at), record["height_m"], what_if)
        except (GeometryError, InputError) as error:
            return record | {"error": str(error)}
        return record | {"match": match}

    def check_unchanged(self) -> None:
        """Refuse to look at a surface that is no more the one that was opened.

        Raises
        ------
        InputError
            It was made again, or removed.
        """
        if self._now() != self._state:
            raise InputError(MADE_AGAIN)

    def _now(self) -> tuple[int, int] | None:
        """What tells whether the run is still the one that was opened."""
        try:
            found = (self.folder.out / RECORD).stat()
        except OSError:
            return None
        return found.st_mtime_ns, found.st_size

    def summary(self) -> dict[str, Any]:
        """What the page has to know before it shows anything."""
        folder, run = self.folder, self.folder.run
        try:
            config = config_of(folder.out, run)
        except ConfigError:
            config = RunConfig()  # the scene does not open then, and says why
        rows, cols = folder.shape
        return {
            "title": folder.out.resolve().name, "shape": [rows, cols], "transform": list(folder.transform)[:6],
            "crs": "a local frame" if folder.is_local else folder.crs.name, "above": folder.above,
            "axes": ["x", "y"] if folder.is_local else ["E", "N"],
            "levels": max(math.ceil(math.log2(max(rows, cols) / FEWEST_LEVEL_CELLS)), 0),
            "layers": [
                {"name": layer.name, "title": layer.title, "legend": layer.legend} for layer in self.layers.values()
            ],
            "made": run.get("created", ""),
            "images": list(run["orientation"]["views"]), "method": run["config"]["request"]["method"],
            "small_window": config.cost.small_window, "max_images_for_large_window": config.cost.max_images_for_large_window,
            "min_images_for_choice": config.selection.min_images_for_choice, "views": run["config"]["request"]["views"],
            "options": options_record(config.selection),
            "window": {"value": large_window_side(config.cost), "choices": list(WINDOWS)},
            "cells": self._cells(),
        }  # fmt: skip

    def _cells(self) -> list[dict[str, Any]]:
        """Cells that the report shows, to begin with."""
        path = self.folder.out / CURVES
        if not path.exists():
            return []
        try:
            cells = read_record(path)["cells"]
            return [{"x": c["x"], "y": c["y"], "what": f"{KIND_WORDS[c['kind']]}: {c['why']}"} for c in cells]
        except (ZlocusError, KeyError, TypeError):
            return []


def options_record(selection: SelectionOptions) -> list[dict[str, Any]]:
    """Options of the selection as the page asks for them."""
    return [
        {
            "name": f.name, "doc": f.metadata["doc"], "value": getattr(selection, f.name), "low": f.metadata["low"],
            "high": MOST.get(f.name, f.metadata["high"]), "choices": f.metadata["choices"], "unit": f.metadata["unit"],
            "is_whole": KINDS[f.name] is int,
        }
        for f in fields(selection)
        if f.name not in OF_RUNS
    ]  # fmt: skip


def _progress(future: Future[Any]) -> dict[str, Any]:
    if not future.done():
        return {"is": "opening"}
    error = _failure(future)
    return {"is": "ready"} if error is None else {"is": "failed", "why": said(error)}


def _failure(future: Future[Any]) -> Exception | None:
    """Why a future that is done failed, None where it did not."""
    error = future.exception()
    return error if isinstance(error, Exception) else None


def _done(future: Future[T] | None) -> T | None:
    """What a future gave, None before or where it failed."""
    if future is None or not future.done() or future.exception() is not None:
        return None
    return future.result()
