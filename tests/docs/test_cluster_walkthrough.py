"""The lesson on a cluster: its lines, run one after the other on a small scene, with a worker that is killed."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from places import ROOT

pytest.importorskip("distributed", reason="distributed is not installed: no cluster")
PAGE = ROOT / "docs" / "tutorials" / "on_a_cluster.md"
# The scene and its halves, smaller; tiles too, so that there are some.
IN_SMALL = {
    "--size 1200": "--size 176",
    "462000 5246400 462350 5247000": "462000 5246912 462050 5247000",
    "462250 5246400 462600 5247000": "462040 5246912 462088 5247000",
}
SMALL_TILES = " --set pyramid.tile=96"
COMPILING = "python -m zlocus.pipeline.execution.precompile match\n"


def free_port() -> str:
    with socket.socket() as listening:
        listening.bind(("127.0.0.1", 0))
        return str(listening.getsockname()[1])


def lines_in_small() -> str:
    """All lines for the shell of the page; kernels are compiled already."""
    text = "".join(re.findall(r"^```bash\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE))
    assert COMPILING in text
    for words, smaller in (IN_SMALL | {"8786": free_port(), COMPILING: ""}).items():
        assert words in text, words
        text = text.replace(words, smaller)
    return text.replace("--resolution 0.5", f"--resolution 0.5{SMALL_TILES}")


def test_the_lines_of_the_page_end_with_a_judged_mosaic(tmp_path):
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    stop = "trap 'kill -9 $(cat *.pid) 2> /dev/null || true' EXIT\n"
    text = stop + "set -e\n" + lines_in_small()
    done = subprocess.run(
        ["bash", "-c", text], cwd=tmp_path, env=os.environ | {"PATH": path}, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    assert "already finished" in done.stdout
    assert "Left: task 3." in done.stdout
    assert (tmp_path / "surface" / "finished.json").exists()
    assert (tmp_path / "whole" / "contours.gpkg").exists()
    assert (tmp_path / "judged" / "error.tif").exists()
