"""What a command saves on its way in and out."""

from __future__ import annotations

import atexit
import gc
import sys
from typing import Any, cast

# Objects made since the last look for cycles, of which imports make hundreds of thousands and leave none; fewer looks
# at older ones.
LOOKS = (50_000, 20, 50)


def prepare() -> None:
    """Set up a process that runs one command and ends: a third of a second less for each.

    Cycles are looked for more rarely, and not once more among all modules at the end. pyogrio, which writes layers of
    points, takes pandas with it where it is there, for frames that no command makes: it is not to be found.
    """
    gc.set_threshold(*LOOKS)
    atexit.register(gc.freeze)
    cast(dict[str, Any], sys.modules).setdefault("pandas", None)
