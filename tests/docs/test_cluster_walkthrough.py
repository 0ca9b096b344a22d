"""The lesson on a cluster: its lines, run one after the other on a small scene, with a worker that is killed."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from docs_commands import Step
from places import ROOT
from typed_commands import is_run_here, run_here

pytest.importorskip("distributed", reason="distributed is not installed: no cluster")
PAGE = ROOT / "docs" / "tutorials" / "on_a_cluster.md"
# The scene and its halves, smaller; tiles too, so that there are some.
IN_SMALL = {
    "--size 1200": "--size 176",
    "pyramid.tile=512": "pyramid.tile=96",
    "462000 5246400 462350 5247000": "462000 5246912 462050 5247000",
    "462250 5246400 462600 5247000": "462040 5246912 462088 5247000",
}
COMPILING = "python -m zlocus.pipeline.execution.precompile match\n"


def free_port() -> str:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return str(listening.getsockname()[1])


def blocks_in_small() -> list[str]:
    """The blocks for the shell of the page; kernels are compiled already."""
    text = PAGE.read_text(encoding="utf-8")
    for words, smaller in (IN_SMALL | {"8786": free_port(), COMPILING: ""}).items():
        assert words in text, words
        text = text.replace(words, smaller)
    return re.findall(r"^```bash\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def parts_of(block: str) -> list[str]:
    """The lines of a block: those of zlocus that ask nothing of the shell one by one, others as far as they stand
    together, with all lines after one that works in the background."""
    parts: list[list[str]] = []
    for line in block.splitlines():
        is_own = is_run_here(Step(line), Path("no folder"))
        stays = bool(parts) and not is_run_here(Step(parts[-1][-1]), Path("no folder"))
        if stays and (not is_own or any("&" in each for each in parts[-1])):
            parts[-1].append(line)
        else:
            parts.append([line])
    return ["\n".join(lines) for lines in parts]


@pytest.fixture
def folder(tmp_path):
    """An empty folder, whose processes are ended after the test."""
    yield tmp_path
    for path in tmp_path.glob("*.pid"):
        with contextlib.suppress(ProcessLookupError):
            os.kill(int(path.read_text()), signal.SIGKILL)


def test_the_lines_of_the_page_end_with_a_judged_mosaic(folder):
    environment = os.environ | {"PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])}
    said = ""
    for part in (part for block in blocks_in_small() for part in parts_of(block)):
        if is_run_here(Step(part), folder):
            said += run_here(shlex.split(part), folder)
            continue
        done = subprocess.run(["bash", "-ec", part], cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, f"{part}\n{done.stdout}\n{done.stderr}"
        said += done.stdout
    assert "already finished" in said
    assert "Left: task 3." in said
    assert (folder / "whole" / "contours.gpkg").exists()
    assert (folder / "judged" / "error.tif").exists()
