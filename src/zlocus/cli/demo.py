"""`zlocus demo`: the built-in scene, rendered, matched and judged."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.core.requests import DEMO_ACCURACY, DEMO_BEGUN, check_output


@dataclass(frozen=True)
class DemoOptions:
    """Options of `zlocus demo`."""

    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the scene and the result.")] = Path("demo")


def demo(options: DemoOptions, console: Console) -> Answer:
    """Render the built-in scene, make its surface, report accuracy."""
    out = options.out
    # The folder of an earlier demo may be used again, that of any other run may not.
    check_output(out, overwrite=any((out / name).exists() for name in (DEMO_ACCURACY, DEMO_BEGUN)))
    from zlocus.evaluation.table import evaluation_table
    from zlocus.io.atomic_write import write_atomically
    from zlocus.pipeline.demo import run_demo

    result = run_demo(out, console.progress)
    accuracy = {f"within_{each.threshold_m:g}_m": each.as_dict() for each in result.evaluations}
    text = json.dumps(accuracy, indent=2) + "\n"
    write_atomically(out / DEMO_ACCURACY, lambda part: part.write_text(text, encoding="utf-8"))
    tables = [evaluation_table(evaluation) for evaluation in result.evaluations]
    parts = [f"Accuracy of {result.out} against the rendered truth:", *tables]
    return Answer("\n\n".join(parts), {"accuracy": accuracy}, is_asked_for=True)
