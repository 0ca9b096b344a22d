"""Write the measured figures of the pages from the results files in benchmarks/results: `make figures`, or

    python benchmarks/pages [--check] [--stale] [--fail] [--numbers]

Nothing is measured, and a page that shows its results already is not written. With `--check` no page is written and
each difference is told; the exit status is then 1 if there is one. With `--stale` the results that are older than the
code that they measure are listed, and with `--fail` the exit status is 1 if there are any. With `--numbers` the
numbers that are no measured figures are accepted as they are.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Python puts the folder of this script first; its modules are those of the package `pages`.
sys.path[:] = [str(HERE.parent), *(path for path in sys.path if Path(path or ".").resolve() != HERE)]

from pages.all_pages import accept_numbers, check_pages, stale_results, write_pages  # noqa: E402
from workplace import CannotRun  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python benchmarks/pages", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="only tell how pages differ from the results files")
    parser.add_argument("--stale", action="store_true", help="list results that are older than the code they measure")
    parser.add_argument("--fail", action="store_true", help="with --stale: exit status 1 if there are any")
    parser.add_argument("--numbers", action="store_true", help="accept the numbers that are no measured figures")
    options = parser.parse_args()
    try:
        if options.numbers:
            accept_numbers()
            return 0
        if options.check:
            found = check_pages()
            print("\n".join(found) or "All pages show their results.")
            return 1 if found else 0
        if not options.stale:
            for page in write_pages():
                print(f"{page} is written anew.")
    except CannotRun as reason:
        sys.exit(f"Error: {reason}")
    stale = stale_results()
    print("\n".join(stale) or "No results are older than the code that they measure.")
    return 1 if stale and options.fail else 0


if __name__ == "__main__":
    sys.exit(main())
