"""Restore the match scene of a finished run from run.json and the observations that the run wrote."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from zlocus.core.errors import InputError
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress, SilentProgress
from zlocus.core.requests import SetupRequest
from zlocus.io.stored_files import is_remote
from zlocus.pipeline.fingerprint import digest_of
from zlocus.pipeline.recorded_run import config_of, request_of
from zlocus.pipeline.report_inputs import ReportedRun
from zlocus.pipeline.setup import open_inputs, orient_views, set_up_run
from zlocus.products.report.file_names import RECORD
from zlocus.products.tie_observations import OBSERVATIONS, read_observations


@dataclass(frozen=True)
class Restored:
    """The scene of a finished run.

    is_same : whether cameras, heights and grey values are the same as in the run; None where the run recorded no
    fingerprint.
    """

    run: ReportedRun
    config: RunConfig
    is_same: bool | None


def restored(
    out: Path, run: Mapping[str, Any], may_read_remote: bool = False, progress: Progress | None = None
) -> Restored:
    """Restore the scene of the run in a folder.

    run : content of run.json; may_read_remote : whether images that it names on a server may be read.

    Raises
    ------
    InputError
        An image or another file of the run was moved, or the observations of the ties are missing.
    ConfigError, GeometryError
        run.json is not what a run writes.
    """
    record, progress = out / RECORD, progress or SilentProgress()
    request, config = request_of(record, run), config_of(record, run)
    remote = [each["path"] for each in run["inputs"] if is_remote(Path(each["path"]))]
    remote += [str(path) for path in request.inputs if is_remote(path)]
    if remote and not may_read_remote:
        raise InputError(
            f"The run read {remote[0]} from a server, which is not read again without permission. Add --remote to see "
            "match curves."
        )
    opened = open_inputs(SetupRequest.of(request), progress)
    ties = read_observations(out, len(opened.scene.views))
    if ties is None and run["orientation"].get("n_ties"):
        raise InputError(
            f"{out / OBSERVATIONS} is missing or damaged. The cameras of the run cannot be restored without it. "
            "Make the surface again."
        )
    orientation = orient_views(opened.scene, config.orientation, progress, known_ties=ties)
    setup = set_up_run(SetupRequest.of(request), opened, orientation, config, progress)
    known = run.get("setup_sha256")
    is_same = None if known is None else digest_of(setup.match_scene, orientation) == known
    return Restored(ReportedRun.of(setup, opened.vertical_datum), config, is_same)
