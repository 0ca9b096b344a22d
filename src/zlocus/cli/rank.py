"""`zlocus rank`: how well each pair of images matches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import config_of
from zlocus.cli.console import Console
from zlocus.cli.shared_options import ConfigFile, Crs, Inputs, Overwrite, Resolution, Settings, TieHeights, Workers
from zlocus.core.requests import RankRequest, check_output


@dataclass(frozen=True)
class RankOptions:
    """Arguments and options of `zlocus rank`."""

    inputs: Inputs
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the ranking.")]
    resolution: Resolution = None
    crs: Crs = None
    heights: TieHeights = None
    workers: Workers = 1
    overwrite: Overwrite = False
    config: ConfigFile = None
    settings: Settings = None


def rank(options: RankOptions, console: Console) -> Answer:
    """Rank images by how well pairs match at the tie points."""
    request = RankRequest(
        tuple(options.inputs), options.out, options.resolution, options.crs, options.heights, options.workers,
        options.overwrite,
    )  # fmt: skip
    check_output(request.out, request.overwrite)
    config = config_of(options.config, options.settings)
    from zlocus.io.run_record import read_record
    from zlocus.pipeline.rank import RANKING_TABLE, run_rank

    text = run_rank(request, config, console.progress)
    return Answer(text, {"ranking": read_record(request.out / RANKING_TABLE)}, is_asked_for=True)
