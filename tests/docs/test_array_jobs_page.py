"""The scripts of the page on array jobs, run by a scheduler that does every job at once."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from docs_commands import lay_out_images
from places import ROOT

PAGE = ROOT / "docs" / "how-to" / "array_jobs.md"
# Takes the words of SLURM's `sbatch` that the page uses. It keeps a line for each job that it has done, and refuses one
# that depends on another which is not done.
SBATCH = """#!/usr/bin/env python3
import argparse, os, subprocess, sys
from pathlib import Path
parser = argparse.ArgumentParser(allow_abbrev=False)
for name in ("dependency", "array", "cpus-per-task", "mem", "time", "wrap"):
    parser.add_argument("--" + name)
parser.add_argument("--parsable", action="store_true")
parser.add_argument("--requeue", action="store_true")
job, jobs = parser.parse_args(), Path("jobs.txt")
done = jobs.read_text().split() if jobs.exists() else []
if job.dependency and job.dependency.removeprefix("afterok:") not in done:
    sys.exit("it depends on " + job.dependency)
first, last = (job.array or "1-1").split("-")
for number in range(int(last), int(first) - 1, -1):
    subprocess.run(["sh", "-c", job.wrap], check=True, env=os.environ | {"SLURM_ARRAY_TASK_ID": str(number)}, stdout=2)
jobs.write_text(" ".join([*done, str(4000 + len(done))]))
print(4000 + len(done))
"""


@pytest.fixture
def folder(tmp_path):
    """A folder with the images of the page, and the programs that its scripts call."""
    lay_out_images(tmp_path)
    (tmp_path / "bin").mkdir()
    program = tmp_path / "bin" / "sbatch"
    program.write_text(SBATCH)
    program.chmod(0o755)
    return tmp_path


def scripts() -> list[str]:
    return re.findall(r"^```bash\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def done(script: str, folder: Path) -> None:
    path = os.pathsep.join([str(folder / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]])
    run = subprocess.run(
        ["bash", "-c", script], cwd=folder, env=os.environ | {"PATH": path}, capture_output=True, text=True
    )  # fmt: skip
    assert run.returncode == 0, run.stderr


def test_the_jobs_make_a_surface(folder):
    """With three tasks instead of a hundred."""
    (jobs, by_hand) = scripts()
    assert jobs.count("100") == 2
    done(jobs.replace("100", "3"), folder)
    assert (folder / "surface" / "finished.json").exists()
    assert (folder / "jobs.txt").read_text().split() == ["4000", "4001", "4002"]
    plan = "zlocus tiles plan by_hand img_1.tif img_2.tif img_3.tif --tasks 3"
    done(f"{plan} && {by_hand.replace('100', '3').replace('surface', 'by_hand')}", folder)
    done("zlocus tiles assemble by_hand", folder)
    assert (folder / "by_hand" / "dsm.tif").read_bytes() == (folder / "surface" / "dsm.tif").read_bytes()


def test_a_job_whose_task_fails_assembles_nothing(folder):
    jobs, _ = scripts()
    with pytest.raises(AssertionError, match="4 is none of them"):
        done(jobs.replace("--tasks 100", "--tasks 3").replace("1-100", "1-4"), folder)
    assert not (folder / "surface" / "dsm.tif").exists()
