"""The folder of a result: made for a run, and cleared of what an earlier run left in it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from zlocus.core.errors import OutputError
from zlocus.core.requests import FINISHED
from zlocus.io.atomic_write import remove_earlier
from zlocus.products.derived import remove_derived
from zlocus.products.report.file_names import remove_report
from zlocus.products.tie_layers import TIES
from zlocus.products.tie_observations import OBSERVATIONS

# Names of files that are not complete yet; they contain the number of the process that writes them.
INCOMPLETE_FILE = re.compile(r"\..+\.\d+\.(part|cog|cells|mask)(\.\w+)?")


@contextmanager
def made_folder(folder: Path) -> Iterator[None]:
    """Make a folder with its parents; after a failure, remove those that were made, as far as they are empty.

    Raises
    ------
    OutputError
        The folder cannot be made.
    """
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be made: {error.strerror}. Choose another folder with -o.") from error
    try:
        yield
    except BaseException:
        with suppress(OSError):  # a folder that holds something stays
            for path in new:
                path.rmdir()
        raise


def remove_earlier_products(out: Path, has_incomplete: bool = True) -> None:
    """Remove the products of an earlier run, so that old and new products never stand together.

    has_incomplete : whether incomplete files are those of earlier runs, and removed too.

    Raises
    ------
    OutputError
        A file cannot be removed.
    """
    remove_derived(out)
    remove_report(out)
    remove_earlier(out, (FINISHED, "run.json", TIES, OBSERVATIONS))
    if has_incomplete:
        remove_incomplete_files(out)


def remove_incomplete_files(out: Path) -> None:
    """Remove the incomplete files of runs that were killed.

    The caller's run has none yet, and no other run writes to the folder at the same time.
    """
    for path in out.iterdir():
        if INCOMPLETE_FILE.fullmatch(path.name):
            path.unlink(missing_ok=True)
