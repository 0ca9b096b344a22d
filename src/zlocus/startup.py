"""What a command saves on its way in and out."""

from __future__ import annotations

import atexit
import gc
import sys
from typing import Any, cast

# Imports make hundreds of thousands of objects and no cycles: cycles are looked for after so many new ones, not 700.
NEW_OBJECTS = 50_000


def prepare() -> None:
    """Set up a process of its own for one command, which starts and ends a tenth of a second sooner, and writes layers
    of points without another two.

    Cycles are looked for more rarely, and not once more among all modules at the end. pyogrio imports pandas where it
    is there, for frames that no command makes: `import pandas` fails from here on.
    """
    gc.set_threshold(NEW_OBJECTS)
    atexit.register(gc.freeze)
    cast(dict[str, Any], sys.modules).setdefault("pandas", None)
