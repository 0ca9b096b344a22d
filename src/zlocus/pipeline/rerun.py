"""`zlocus rerun`: a surface or a cloud made again from its run.json, with the same inputs and options."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from zlocus.core.errors import CoverageError, InputError
from zlocus.core.progress import Progress, SilentProgress
from zlocus.core.quoting import counted
from zlocus.core.request_checks import is_scene_file
from zlocus.core.requests import CloudRequest, DsmRequest, SetupRequest, check_output
from zlocus.core.rerun_request import RerunRequest
from zlocus.io.archives import is_archived
from zlocus.io.run_record import inputs_record, processor_name, read_record, versions_record
from zlocus.io.stored_files import is_remote
from zlocus.pipeline.cloud import run_cloud
from zlocus.pipeline.dsm import run_dsm
from zlocus.pipeline.fingerprint import COMMANDS, kernels_of_package
from zlocus.pipeline.finished_record import checksum
from zlocus.pipeline.recorded_run import DATUMS, FILES, config_of, folder_of, request_with
from zlocus.pipeline.setup import open_inputs
from zlocus.products.report.file_names import RECORD

# Fields that the request of a command has, and other commands have not, for records that do not name their command.
FIELDS = {DsmRequest: {"products", "fill"}, CloudRequest: {"references", "fill"}}


@dataclass(frozen=True)
class SameRasters:
    """Which rasters of two runs have the same bytes.

    same, other : names of those that have, and of those that have not; both are empty where the record has no
    checksums of rasters.
    """

    same: tuple[str, ...]
    other: tuple[str, ...]

    def __str__(self) -> str:
        if self.other:
            return f"Other bytes than recorded: {', '.join(self.other)}."
        if self.same:
            return f"All {len(self.same)} rasters have the recorded bytes."
        return "The record has no checksums of rasters, so their bytes cannot be compared."


@dataclass(frozen=True)
class RerunResult:
    """Result of `run_again`. out : folder of the products; coverage : see `DsmResult` and `CloudResult`."""

    out: Path
    coverage: float
    same_rasters: SameRasters
    was_finished: bool = False

    def __str__(self) -> str:
        state = "already finished, " if self.was_finished else ""
        return (
            f"{self.out}: {state}a height for {100 * self.coverage:.1f} % of what two images see. {self.same_rasters}"
        )


def run_again(request: RerunRequest, progress: Progress) -> RerunResult:
    """Repeat a run from its record, and compare the rasters with the recorded checksums.

    Raises
    ------
    InputError
        The record is none of a surface or a cloud, or an input was moved or has changed since.
    ZlocusError
        See `run_dsm` and `run_cloud`.
    """
    path = request.record / RECORD if request.record.is_dir() else request.record
    run = read_record(path)
    kind = kind_of(path, run)
    if n_redone := len(run.get("redone", [])):
        raise InputError(
            f"{path} is of a surface of which {counted(n_redone, 'part')} {'was' if n_redone == 1 else 'were'} redone, "
            "and a rerun repeats one run. Make the surface with `zlocus dsm` and the options in run.json, and repeat "
            "each --redo of its history."
        )
    check_output(request.out, request.overwrite, may_be_same=True)
    with progress.stage("Checking inputs"):
        again, config = recorded_request(request, path, run, kind), config_of(path, run)
    for sentence in differences(run):
        progress.note(sentence)
    try:
        if isinstance(again, DsmRequest):
            surface = run_dsm(again, config, progress)
            coverage, was_finished = surface.coverage, surface.was_finished
        else:
            cloud = run_cloud(again, config, progress)
            coverage, was_finished = cloud.coverage, cloud.was_finished
    except CoverageError:  # all products are written; the recorded run has ended so, too
        progress.note(str(compared(request.out, run)))
        raise
    return RerunResult(request.out, coverage, compared(request.out, run), was_finished)


def kind_of(path: Path, run: Mapping[str, Any]) -> type[Any]:
    """The kind of request that a record holds. path : of the record, for messages.

    Raises
    ------
    InputError
        It is the record of another command, or none.
    """
    config = run.get("config")
    asked = config.get("request") if isinstance(config, dict) else None
    if isinstance(asked, dict) and isinstance(asked.get("inputs"), list):
        for kind, command in COMMANDS.items():
            if run.get("command", command) == command and FIELDS[kind] <= set(asked):
                return kind
    raise InputError(
        f"{path} is not the record of a surface or a point cloud. Give the run.json that `zlocus dsm` or "
        "`zlocus cloud` wrote."
    )


def recorded_request(
    request: RerunRequest, path: Path, run: Mapping[str, Any], kind: type[Any]
) -> DsmRequest | CloudRequest:
    """The recorded request with the present places of its files, whose content is what the run has read.

    What changes no result is that of the new request: workers, memory and where the result goes.

    Raises
    ------
    InputError
        An input was moved or has changed since, or the record is damaged.
    """
    _check_inputs_recorded(path, run)
    places = Places(path, run, request.inputs, folder_of(path.parent, run))
    unplaced = places.checked()
    others: dict[str, Any] = {
        "out": request.out, "overwrite": request.overwrite, "resume": request.resume, "memory_gb": request.memory_gb,
    }  # fmt: skip
    if kind is DsmRequest:
        others |= {"workers": request.workers, "scheduler": request.scheduler}
    else:
        others |= {"workers": request.workers or 1}
    run = {**run, "config": {**run["config"], "request": places.with_inputs_read(run["config"]["request"])}}
    again = request_with(path, run, kind, places.of, others)
    if unplaced:
        places.check_opened(unplaced, again)
    return cast(DsmRequest | CloudRequest, again)


def _check_inputs_recorded(path: Path, run: Mapping[str, Any]) -> None:
    """Refuse a record whose inputs are not what a run writes."""
    inputs = run.get("inputs")
    is_list = isinstance(inputs, list) and all(isinstance(each, dict) for each in inputs)
    if not is_list or not all(
        isinstance(each.get("path"), str) and isinstance(each.get("sha256", 0), str | None) for each in run["inputs"]
    ):
        raise InputError(f"{path} does not hold the checksums of its inputs. Make the surface again.")


@dataclass(frozen=True)
class Places:
    """Where the files of a recorded run are now.

    record : its run.json; run : the content; inputs : folder that holds the files, None where they are where they were;
    base : folder in which relative paths begin.
    """

    record: Path
    run: Mapping[str, Any]
    inputs: Path | None
    base: Path

    def of(self, recorded: str) -> Path:
        """The present place of a file.

        In the folder of the inputs the longest end of its path counts that exists there: of /a/b/c.tif, a/b/c.tif, then
        b/c.tif, then c.tif.
        """
        if self.inputs is not None:
            parts = [part for part in Path(recorded).parts if part not in ("/", "..")]
            for first in range(len(parts)):
                if (place := self.inputs.joinpath(*parts[first:])).is_file():
                    return place
        # In the same folder the same names, so that the same command finds the run finished.
        return Path(recorded) if self.base == Path.cwd() else self.base / recorded

    @property
    def read(self) -> dict[str, str]:
        """Checksum of every file that the run has read, by its recorded path; not of those on servers."""
        return {each["path"]: each["sha256"] for each in self.run["inputs"] if each["sha256"] is not None}

    def checked(self) -> list[str]:
        """Compare the content of every file that is at its place, and return the recorded paths of the others, which
        the request does not name.

        Raises
        ------
        InputError
            A file has changed, or one that the request names is missing.
        """
        unplaced, asked = list[str](), self.run["config"]["request"]
        named = {*map(str, asked["inputs"]), *(asked.get(name) for name in (*FILES, *DATUMS))}
        for recorded, digest in self.read.items():
            place = self.of(recorded)
            if not place.is_file():
                if recorded in named:
                    raise self._moved(recorded)
                unplaced.append(recorded)
            elif inputs_record([place])[0]["sha256"] != digest:
                raise self._changed(place)
        return unplaced

    def with_inputs_read(self, asked: Mapping[str, Any]) -> dict[str, Any]:
        """The recorded request without images that are gone and that the run has not read, for they show nothing of its
        area."""
        kept = [
            name
            for name in asked["inputs"]
            if name in self.read
            or is_remote(Path(name))
            or is_archived(Path(name))
            or is_scene_file(Path(name))
            or self.of(name).exists()
        ]
        return {**asked, "inputs": kept}

    def check_opened(self, unplaced: Sequence[str], request: DsmRequest | CloudRequest) -> None:
        """Compare files that are not at their places with those that are opened now: images of a scene file, and
        geoids, which have other places on other machines.

        Raises
        ------
        InputError
            A file is missing or has changed.
        """
        opened = open_inputs(SetupRequest.of(request), SilentProgress(), "later").files
        for recorded in unplaced:
            present = [path for path in opened if path.name == Path(recorded).name and not is_remote(path)]
            if not present:
                raise self._moved(recorded)
            if self.read[recorded] not in {record["sha256"] for record in inputs_record(present)}:
                raise self._changed(present[0])

    def _changed(self, place: Path) -> InputError:
        return InputError(
            f"{place} has changed since the run of {self.record}, whose checksum of it is another one. Put the old "
            "file back, or make a new surface with `zlocus dsm`."
        )

    def _moved(self, recorded: str) -> InputError:
        looked = f"{self.of(recorded)}" if self.inputs is None else f"{self.inputs}"
        return InputError(
            f"The input {recorded} of the run of {self.record} is not there any more (looked for at {looked}). Put it "
            "back, or name the folder that holds the inputs now with --inputs."
        )


def differences(run: Mapping[str, Any]) -> list[str]:
    """What is not as it was when a run was recorded, and may change bytes, in sentences."""
    then, now = run.get("versions", {}), versions_record()
    found = [f"{name} {then[name]} (now {now[name]})" for name in now if name in then and then[name] != now[name]]
    sentences = [f"The run was made with {', '.join(found)}, so heights may differ."] if found else []
    if not found and run.get("kernels", kernels_of_package()) != kernels_of_package():
        sentences.append("The run was made with other sources of zlocus, so heights may differ.")
    processor = run.get("processor", processor_name())
    if processor != processor_name():
        sentences.append(f"The run was made on a processor of kind {processor}, and this one is {processor_name()}.")
    return sentences


def compared(out: Path, run: Mapping[str, Any]) -> SameRasters:
    """Which rasters in a folder have the checksums that a record holds."""
    recorded = run.get("rasters")
    checksums = recorded if isinstance(recorded, dict) else {}
    same = {name: (out / name).is_file() and checksum(out / name) == digest for name, digest in checksums.items()}
    return SameRasters(
        tuple(name for name in same if same[name]), tuple(name for name in same if not same[name])
    )  # fmt: skip
