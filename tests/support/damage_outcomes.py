"""The outcome of reading a damaged file: its values, or the sentence that refuses it."""

from __future__ import annotations

import time
import warnings
from dataclasses import dataclass
from pathlib import Path

import damage as d
from damage_cases import Case, Leaves
from zlocus.core.errors import ZlocusError

# Of CPU, for a small file and for one of 10 MB; a quarter of it on a machine that does nothing else.
SECONDS, SECONDS_10_MB, MEGABYTES = 2.0, 5.0, 500
LONGEST = 1500


@dataclass(frozen=True)
class Good:
    case: Case
    path: Path
    content: bytes
    says: Leaves


def outcome(good: Good, content: bytes) -> Leaves | str:
    """What a damaged file says, or what was said of it; in time and memory, without a warning."""
    good.path.write_bytes(content)
    before, started = reset_peak_mb(), time.process_time()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.filterwarnings("ignore", "Use `@` matmul", PendingDeprecationWarning)
            found: Leaves | str = good.case.read(good.path)
    except ZlocusError as error:
        found = str(error)
        check_sentence(found, good.path)
    finally:
        taken, taken_mb = time.process_time() - started, peak_mb() - before
        good.path.write_bytes(good.content)
    assert taken < (SECONDS if len(content) < d.LARGE // 2 else SECONDS_10_MB)
    assert taken_mb < MEGABYTES
    return found


def peak_mb() -> float:
    """The most memory that the process has held."""
    held = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(held["VmHWM"].split()[0]) / 1024


def reset_peak_mb() -> float:
    """The memory it holds, from which the peak is measured next. Source: Linux, proc_pid_clear_refs(5)."""
    Path("/proc/self/clear_refs").write_text("5")
    return peak_mb()


def check_sentence(said: str, path: Path) -> None:
    assert "\n" not in said
    assert said[-1] in ".?"
    assert len(said) < LONGEST
    assert path.name in said or path.parent.name in said or "image" in said
