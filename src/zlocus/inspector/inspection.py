"""A surface that is being looked at: what is known of it at once, and what is made ready meanwhile."""

from __future__ import annotations

import math
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import fields
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Any, TypeVar

from zlocus.errors import GeometryError, ZlocusError
from zlocus.inspector.cell import WhatIf, cell_record, match_record
from zlocus.inspector.folder import SurfaceFolder, surface_folder
from zlocus.inspector.layers import Layer, difference_layer, layers_of
from zlocus.inspector.queries import KINDS, WINDOWS
from zlocus.inspector.reference import Reference, reference_for
from zlocus.inspector.restore import Restored, config_of, restored
from zlocus.options import SelectionOptions
from zlocus.products.record import read_record
from zlocus.products.report.comparison import Comparison
from zlocus.products.report.page import CURVES, KIND_WORDS
from zlocus.reporting import said
from zlocus.threads import submitted

T = TypeVar("T")
FEWEST_LEVEL_CELLS = 128
# Tie points at which a first match is tried.
WARM_PLACES = 8
NOT_THE_SAME = (
    "Cameras or grey values came out otherwise than in the run: an image has changed since, or this is another "
    "machine. Curves may differ from those that the surface rests on."
)


class Inspection:
    """A surface and its scene, which is opened in the background, as is the comparison with a reference.

    As a context it opens the scene, and removes at the end what it keeps on disk.

    Raises
    ------
    InputError
        There is no complete surface in the folder.
    """

    def __init__(self, out: Path, comparison: Comparison | None = None) -> None:
        self.folder: SurfaceFolder = surface_folder(out)
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
        # Who interrupts does not wait for a scene to open, see `zlocus.threads.is_busy`.
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
        found = restored(self.folder.out, self.folder.run)
        # Kernels are compiled, or loaded, before anyone waits for them.
        for xy in found.matched.ties[:: len(found.matched.ties) // WARM_PLACES + 1, :2]:
            try:
                match_record(found, xy, math.nan, WhatIf())
                break
            except ZlocusError:
                continue  # too few images there
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
        if scene is not None and not scene.is_same:
            state["notes"].append(NOT_THE_SAME)
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
        except GeometryError as error:
            return record | {"error": str(error)}
        return record | {"match": match}

    def summary(self) -> dict[str, Any]:
        """What the page has to know before it shows anything."""
        folder, run = self.folder, self.folder.run
        config = config_of(folder.out, run)
        rows, cols = folder.shape
        return {
            "title": folder.out.resolve().name, "shape": [rows, cols], "transform": list(folder.transform)[:6],
            "crs": "a local frame" if folder.is_local else folder.crs.name, "above": folder.above,
            "axes": ["x", "y"] if folder.is_local else ["E", "N"],
            "levels": max(math.ceil(math.log2(max(rows, cols) / FEWEST_LEVEL_CELLS)), 0),
            "layers": [
                {"name": layer.name, "title": layer.title, "legend": layer.legend} for layer in self.layers.values()
            ],
            "has_reference": self.comparison is not None,
            "images": list(run["orientation"]["views"]), "method": run["config"]["request"]["method"],
            "created": run.get("created"), "coverage": run["coverage"],
            "fewest_views": config.selection.fewest_views, "views": run["config"]["request"]["views"],
            "options": options_record(config.selection),
            "window": {"value": config.measure.large_window, "choices": list(WINDOWS)},
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
            "high": f.metadata["high"], "choices": f.metadata["choices"], "unit": f.metadata["unit"],
            "is_whole": KINDS[f.name] is int,
        }
        for f in fields(selection)
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
