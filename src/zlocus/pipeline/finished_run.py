"""The same command after success: its products are checked, and those that are missing are made again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from zlocus.core.errors import OutputError
from zlocus.core.options import ProductOptions, RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import FINISHED, OTHER_FOLDER, CloudRequest, DsmRequest, SetupRequest, held_files
from zlocus.io.run_record import read_record
from zlocus.pipeline.execution.checkpoint import TileCheckpoint, difference
from zlocus.pipeline.fingerprint import digest_of
from zlocus.pipeline.finished_record import ITEM, Finished, checksum, comparable, read_finished, update_finished
from zlocus.pipeline.setup import OpenedInputs, orient_views, set_up_run
from zlocus.products.derived import FILES, link_all, write_derived
from zlocus.products.metadata import METADATA
from zlocus.products.report.file_names import CURVES, FOOTPRINTS, RANKING, RECORD, REPORT
from zlocus.products.styles import missing_styles, write_styles
from zlocus.products.tie_layers import TIES, write_ties
from zlocus.products.tie_observations import OBSERVATIONS, read_observations, write_observations

# Products that only matching makes.
MATCHED = ("dsm.tif", "sigma.tif", "quality.tif", "views.tif", "ortho.tif", "water.tif", RANKING, RECORD)
# Products made from the tie points, which are kept or found again.
OF_TIES = (TIES, OBSERVATIONS, FOOTPRINTS, CURVES)


@dataclass(frozen=True)
class Missing:
    """Products of a finished run that are missing.

    matched : names of the files that only matching makes; of_ties : of those that the tie points make; maps : of maps,
    as --products has them; report : whether that is missing; item : whether the item or the metadata are; styles :
    names of the style files of products that are there.
    """

    matched: tuple[str, ...]
    of_ties: tuple[str, ...]
    maps: tuple[str, ...]
    report: bool
    item: bool
    styles: tuple[str, ...] = ()

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the missing files that can be made without matching."""
        ends = (REPORT,) * self.report + (ITEM,) * self.item
        return (*self.of_ties, *(FILES[name] for name in self.maps), *ends, *self.styles)


def finished_run(request: DsmRequest | CloudRequest, checkpoint: TileCheckpoint) -> Finished | None:
    """The record of the finished run in a request's folder, if it is the requested one.

    None where the folder holds no finished run, or may be overwritten.

    checkpoint : of the request; where it has tiles of the same run, that one was allowed to replace what is there.

    Raises
    ------
    OutputError
        Where the folder holds another run, or the same one that is not to be taken as it is.
    """
    out = request.out
    if request.overwrite:
        return None
    finished, held = read_finished(out), held_files(out)
    if finished is None:
        if held and not checkpoint.is_of_this_run:
            raise OutputError(f"{out} holds another run ({', '.join(held)}). {OTHER_FOLDER}")
        return None
    differs = difference(finished.key, comparable(checkpoint.key)) if finished.key else f"its {FINISHED} is damaged"
    if differs:
        if checkpoint.is_of_this_run:
            return None
        raise OutputError(f"{out} holds another run: {differs}. {OTHER_FOLDER}")
    if not request.resume:
        raise OutputError(
            f"{out} holds this run, already finished, which --no-resume asks not to take. Leave --no-resume out, or "
            "add --overwrite (in Python: overwrite=True) to make it anew."
        )
    return finished


def missing_products(request: DsmRequest, options: ProductOptions, finished: Finished, progress: Progress) -> Missing:
    """Find the products that are missing from a finished run, or requested now in addition. options : of the run.

    Raises
    ------
    OutputError
        A product is not what the run wrote.
    """
    out, gone = request.out, files_gone(request.out, finished, progress)
    shown = {name for name in (REPORT, FOOTPRINTS, CURVES) if not (out / name).is_file()}
    gone = gone | shown if request.report else gone - shown
    return Missing(
        matched=tuple(name for name in MATCHED if name in gone or (name != RANKING and not (out / name).is_file())),
        of_ties=tuple(name for name in OF_TIES if name in gone),
        maps=tuple(name for name in FILES if name in request.products and not (out / FILES[name]).is_file()),
        report=REPORT in gone,
        item=bool({ITEM, METADATA} & gone),
        styles=missing_styles(out, options),
    )


def files_gone(out: Path, finished: Finished, progress: Progress) -> set[str]:
    """Names of the products that are missing from a finished run.

    Raises
    ------
    OutputError
        A product is not what the run wrote.
    """
    gone, other = set[str](), list[str]()
    with progress.stage("Checking products", len(finished.checksums)) as stage:
        for name, digest in finished.checksums.items():
            if not (out / name).is_file():
                gone.add(name)
            elif checksum(out / name) != digest:
                other.append(name)
            stage.advance()
    if other:
        it, is_not = ("them", "are not") if len(other) > 1 else ("it", "is not")
        raise OutputError(
            f"{out} holds this run, already finished, but {', '.join(other)} {is_not} what the run wrote. Remove {it} "
            f"to have {it} made again, or add --overwrite (in Python: overwrite=True) to make the whole run anew."
        )
    return gone


def whole_again(request: DsmRequest, finished: Finished, missing: Missing, progress: Progress) -> DsmRequest:
    """The request of a run that is repeated because products are missing that only matching makes.

    It includes the maps and the report that were added to the finished run later.

    Raises
    ------
    OutputError
        Parts of the run were redone, which the same command does not repeat.
    """
    if finished.n_redone:
        raise OutputError(
            f"The finished run in {request.out} lacks {', '.join(missing.matched)}, which only matching makes, and "
            "parts of it were redone since (--redo), which this command would not repeat. Put the missing files back, "
            "or add --overwrite (in Python: overwrite=True) to make the whole run anew, without these parts."
        )
    progress.note(
        f"The finished run in {request.out} lacks {', '.join(missing.matched)}, which only matching makes: it is made "
        "again."
    )
    maps = tuple(name for name in FILES if name in request.products or FILES[name] in finished.checksums)
    return replace(request, products=maps, report=request.report or REPORT in finished.checksums)


def make_missing(
    request: DsmRequest,
    config: RunConfig,
    opened_inputs: OpenedInputs,
    finished: Finished,
    missing: Missing,
    progress: Progress,
) -> None:
    """Make the missing products of a finished run, and record their checksums; nothing else changes.

    Raises
    ------
    InputError, ConfigError, OutputError
        As the run, where a product cannot be made.
    """
    out = request.out
    if not missing.files:
        return
    try:
        if missing.of_ties:
            _make_of_ties(request, config, opened_inputs, missing.of_ties, progress)
        if missing.maps:
            write_derived(out, missing.maps, config.products, progress)
        write_styles(out, config.products)
        if missing.report:
            from zlocus.pipeline.report_inputs import try_report

            try_report(out, progress)
        if missing.item or set(missing.files) - set(finished.checksums):
            link_all(out, progress)
    finally:
        update_finished(out, (*missing.files, ITEM, METADATA))
    made = [name for name in missing.files if (out / name).is_file()]
    if made:
        progress.note(f"Made, for it was not there: {', '.join(made)}.")


def _make_of_ties(
    request: DsmRequest, config: RunConfig, opened_inputs: OpenedInputs, names: Sequence[str], progress: Progress
) -> None:
    """Make the missing products of the tie points, which are found again where they were not kept."""
    from zlocus.pipeline.report_inputs import ReportedRun, write_shown

    out, record = request.out, read_record(request.out / RECORD)
    known = read_observations(out, len(opened_inputs.scene.views))
    orientation = orient_views(
        opened_inputs.scene, config.orientation, progress, threads=request.workers, known_ties=known
    )  # fmt: skip
    setup = set_up_run(SetupRequest.of(request), opened_inputs, orientation, config, progress)
    if digest_of(setup.match_scene, orientation) != record.get("setup_sha256"):
        raise OutputError(
            f"{', '.join(names)} of {out} cannot be made again, for cameras and heights came out otherwise than in the "
            "run, as they may on another machine. Add --overwrite (in Python: overwrite=True) to make the whole run "
            "anew."
        )
    if TIES in names:
        write_ties(out / TIES, orientation, setup.scene, opened_inputs.vertical_datum)
    if OBSERVATIONS in names and orientation.refined_ties is not None:
        write_observations(out, orientation.refined_ties)
    if shown := [name for name in names if name in (FOOTPRINTS, CURVES)]:
        run = ReportedRun.of(setup, opened_inputs.vertical_datum)
        with progress.stage("Match curves"):
            write_shown(out, run, config, _time_of_matching(record), progress, shown)


def _time_of_matching(record: dict[str, Any]) -> float:
    """Wall time of the matching of a run, s."""
    times = [stage["wall_s"] for stage in record.get("stages", []) if stage.get("name") == "match"]
    return float(times[0]) if times else 0.0
