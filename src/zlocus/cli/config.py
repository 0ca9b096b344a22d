"""`zlocus config`: a complete commented configuration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.core.errors import OutputError


@dataclass(frozen=True)
class ConfigOptions:
    """Options of `zlocus config`."""

    out: Annotated[Path | None, typer.Option("-o", "--out", help="File to write. Without it, or with -, print.")] = None


def config(options: ConfigOptions) -> None:
    """Write a configuration with a comment for every option."""
    from zlocus.core.options import RunConfig
    from zlocus.io.atomic_write import atomic_file
    from zlocus.io.config import write_config

    text, out = write_config(RunConfig()), options.out
    if out is None or str(out) == "-":
        print(text, end="")
        return
    if out.exists():
        raise OutputError(f"{out} exists already and may hold your settings. Choose another name with -o.")
    try:
        with atomic_file(out) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"{out} cannot be written: {error.strerror}. Choose another name with -o.") from error
