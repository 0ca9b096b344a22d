"""Commands of the documents that tests run in their own process, which has loaded imports and kernels already."""

from __future__ import annotations

import contextlib
import re
from glob import glob
from pathlib import Path

from typer.testing import CliRunner

from docs_commands import PROJ_GRIDS, Step
from zlocus.cli.app import app
from zlocus.synthetic.__main__ import main as render

# What stands for the inputs of a run in lines that tell the usage.
INPUTS = "img_1.tif img_2.tif img_3.tif"
RENDERING = ["python", "-m", "zlocus.synthetic"]
# Signs by which a line asks more of the shell than words and `*`.
SHELL = re.compile(r"[|&;<>$`\\~?\[{(]")


def runnable(text: str) -> str:
    """A line of usage as a command: without what is in brackets, and with three images for INPUT."""
    return re.sub(r"\s*\[-[^]]*\]", "", text).replace("INPUT...", INPUTS)


def is_run_here(step: Step, folder: Path) -> bool:
    """Whether a step is a command that this process can run as one of its own would. `inspect` ends by a signal, and
    PROJ looks for a user's grids when a process starts."""
    words = [] if step.is_python else step.text.split()
    if words[:3] == RENDERING:
        return True
    if words[:1] != ["zlocus"] or words[1] == "inspect" or (folder / PROJ_GRIDS).exists():
        return False
    return SHELL.search(runnable(step.text)) is None


def run_here(words: list[str], folder: Path) -> str:
    """Runs a command in this process, in a folder, and returns what it prints; `*` in its words stands for the files of
    the folder."""
    found = [
        sorted(name for name in glob(word, root_dir=folder)) or [word] if "*" in word else [word] for word in words
    ]
    with contextlib.chdir(folder):
        if words[:3] == RENDERING:
            assert render(words[3:]) == 0, " ".join(words)
            return ""
        done = CliRunner().invoke(app, [name for names in found for name in names][1:], catch_exceptions=False)
    assert done.exit_code == 0, f"{' '.join(words)}\n{done.output}"
    return done.stdout
