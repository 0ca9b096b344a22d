"""A page that is served, as the tests ask for it, and a cell to ask for."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rasterio
import uvicorn

from zlocus.evaluation.comparison import Comparison
from zlocus.inspector.guard import new_token
from zlocus.inspector.inspection import Inspection
from zlocus.inspector.server import application
from zlocus.inspector.serving import checked_address, listening

# The scene of a small run is open by then, kernels and all.
OPENED_S = 120.0


def opened(inspection: Inspection) -> Inspection:
    """An inspection once all that is made in the background is there."""
    end = time.monotonic() + OPENED_S
    while any(isinstance(part, dict) and part.get("is") == "opening" for part in inspection.state().values()):
        assert time.monotonic() < end, "the scene does not open"
        time.sleep(0.02)
    return inspection


@contextmanager
def served(out: Path, comparison: Comparison | None = None, wait: bool = True) -> Iterator[tuple[Inspection, str]]:
    """An inspection, and the address of its page; with `wait` once the scene is open."""
    with listening(checked_address("127.0.0.1"), 0) as listener, Inspection(out, comparison) as inspection:
        host, token = f"127.0.0.1:{listener.getsockname()[1]}", new_token()
        config = uvicorn.Config(application(inspection, token, frozenset({host})), log_level="warning", ws="none")
        server = uvicorn.Server(config)
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
        thread.start()
        try:
            yield opened(inspection) if wait else inspection, f"http://{host}/{token}/"
        finally:
            server.should_exit = True
            thread.join(OPENED_S)


def heights_of(out: Path) -> np.ndarray:
    with rasterio.open(out / "dsm.tif") as file:
        return file.read(1)


def a_cell(out: Path) -> tuple[int, int]:
    """A cell with a height, nearest to the middle."""
    known = np.isfinite(heights_of(out))
    rows, cols = np.nonzero(known)
    middle = np.argmin(np.hypot(rows - known.shape[0] / 2, cols - known.shape[1] / 2))
    return int(rows[middle]), int(cols[middle])
