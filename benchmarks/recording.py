"""Run a script of this folder and keep the tables that it prints in a results file, from which pages show them.

    python benchmarks/recording.py NAME SCRIPT [OPTION ...]

The tables, in Markdown, go to benchmarks/results/NAME.json with the commit, date, machine and command. A page shows the
N-th of them with `<!-- table: NAME-N -->` (see `pages/spans.py`). Everything that the script prints is printed too.
"""

from __future__ import annotations

import argparse
import re
import shlex
import subprocess
import sys
import time

from result_files import PACKAGE, RENDERER, Table, code_of, record_results
from workplace import ROOT, CannotRun, ended

RULE = re.compile(r"^\|(?:\s*:?-+:?\s*\|)+$")
# An escaped bar is part of its cell.
BAR = re.compile(r"(?<!\\)\|")


def tables_of(text: str) -> list[Table]:
    """The tables in Markdown of a text, each as its lines of cells, the heading first."""
    lines, tables = text.splitlines(), []
    for at in range(1, len(lines)):
        if RULE.match(lines[at].strip()) and lines[at - 1].startswith("|"):
            table = [cells_of(lines[at - 1])]
            for line in lines[at + 1 :]:
                if not line.startswith("|"):
                    break
                table.append(cells_of(line))
            tables.append(table)
    return tables


def cells_of(line: str) -> list[str]:
    """Cells of a line of a table."""
    return [cell.strip().replace("\\|", "|") for cell in BAR.split(line.strip())[1:-1]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", metavar="NAME", help="of the results file")
    parser.add_argument("script", metavar="SCRIPT", help="name of a script of benchmarks/, such as roofline.py")
    parser.add_argument("options", nargs=argparse.REMAINDER, metavar="OPTION", help="of the script")
    words = parser.parse_args()
    script = f"benchmarks/{words.script}"
    code, start = code_of((PACKAGE, RENDERER, script)), time.monotonic()
    command = [sys.executable, str(ROOT / script), *words.options]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    print(done.stdout, end="", flush=True)
    tables = tables_of(done.stdout)
    if done.returncode or not tables:
        raise CannotRun(
            f"{script} ends with status {done.returncode} and prints {len(tables)} tables: nothing is kept."
        )
    told = shlex.join(["python", "benchmarks/recording.py", words.name, words.script, *words.options])
    record_results(words.name, (), told, seconds=time.monotonic() - start, code=code, tables=tables)


if __name__ == "__main__":
    ended(main)
