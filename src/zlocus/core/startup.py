"""What a command saves on its way in and out."""

from __future__ import annotations

import atexit
import gc
import sys
from typing import Any, cast

# Imports make hundreds of thousands of objects and no cycles: cycles are looked for after so many new ones, not 700.
NEW_OBJECTS = 50_000
# What libraries import where it is there, for data that no command has: pyogrio for frames, odc-geo for delayed arrays.
LEFT_OUT = ("pandas", "dask")


def prepare() -> None:
    """Set up a process of its own for one command, which starts and ends a fifth of a second sooner, and writes layers
    of points without another fifth.

    Cycles are looked for more rarely, and not once more among all modules at the end. To import what is in `LEFT_OUT`
    fails from here on, until it is let in.
    """
    gc.set_threshold(NEW_OBJECTS)
    atexit.register(gc.freeze)
    for name in LEFT_OUT:
        cast(dict[str, Any], sys.modules).setdefault(name, None)


def let_in(name: str) -> None:
    """Let a module be imported after all that `prepare` left out."""
    if sys.modules.get(name, sys) is None:
        del sys.modules[name]
