"""Request of `zlocus rerun`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.request_checks import check_positive, check_workers


@dataclass(frozen=True)
class RerunRequest:
    """A run to be repeated. `None` means: not given.

    record : run.json of the run, or the folder that holds it; out : folder of the new result, another one; inputs :
    folder that holds the inputs now; workers, memory_gb, scheduler, overwrite, resume : as in `DsmRequest`, of this
    run and not of the recorded one, because they change no result.

    Raises
    ------
    ConfigError
        A value out of range.
    """

    record: Path
    out: Path
    inputs: Path | None = None
    workers: int | None = None
    memory_gb: float | None = None
    scheduler: str | None = None
    overwrite: bool = False
    resume: bool = True

    def __post_init__(self) -> None:
        check_workers(self.workers)
        check_positive("--memory", self.memory_gb, "GB")
        if self.inputs is not None and not self.inputs.is_dir():
            raise ConfigError(f"--inputs {self.inputs} is no folder. Name the folder that holds the inputs of the run.")
