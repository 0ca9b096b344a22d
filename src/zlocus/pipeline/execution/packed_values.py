"""Values of a run as bytes, for processes that start later: Python's own serialisation, of known classes only.

Reading bytes runs no code but the construction of values: each class must be a dataclass, a named tuple or an
enumeration of this package, or stand in `LIBRARY_CLASSES`.
"""

from __future__ import annotations

import io
import pickle
from dataclasses import is_dataclass
from enum import Enum
from typing import Any

# Classes and functions of libraries that values may consist of, by module; () allows every class of the module.
LIBRARY_CLASSES: dict[str, tuple[str, ...]] = {
    "affine": ("Affine",),
    "builtins": ("complex", "frozenset", "range", "set", "slice"),
    "collections": ("OrderedDict",),
    "datetime": (),
    "numpy": ("dtype", "ndarray"),
    "numpy._core.multiarray": ("_reconstruct", "scalar"),
    "numpy._core.numeric": ("_frombuffer",),
    "numpy.core.multiarray": ("_reconstruct", "scalar"),
    "numpy.core.numeric": ("_frombuffer",),
    "odc.geo.crs": ("CRS",),
    "odc.geo.geobox": ("GeoBox",),
    "odc.geo.types": (),
    "pathlib": (),
    "pathlib._local": (),
    "pyproj.crs.crs": (),
    "pyproj.transformer": (),
    "shapely.io": ("from_wkb",),
}
OURS = "zlocus."


class UnknownClassError(ValueError):
    """Bytes that name a class of which no value is read."""


class _KnownClasses(pickle.Unpickler):
    """Reads values of known classes only."""

    def find_class(self, module: str, name: str) -> Any:
        """The class or function of a name, see `pickle.Unpickler`."""
        if "." not in name and (module.startswith(OURS) or module in LIBRARY_CLASSES):
            found = super().find_class(module, name)
            if _is_known(module, name, found):
                return found
        raise UnknownClassError(f"{module}.{name} is no class whose values are kept")


def _is_known(module: str, name: str, found: Any) -> bool:
    if module.startswith(OURS):
        is_value = is_dataclass(found) or (isinstance(found, type) and issubclass(found, Enum | tuple))
        return is_value and found.__module__ == module
    return name in LIBRARY_CLASSES[module] or (not LIBRARY_CLASSES[module] and isinstance(found, type))


def packed(value: Any) -> bytes:
    """A value as bytes, which `unpacked` reads in a process with the same versions of all libraries.

    Raises
    ------
    UnknownClassError
        The value, or a part of it, is of a class that would not be read.
    """
    content = pickle.dumps(value, protocol=5)
    unpacked(content)
    return content


def unpacked(content: bytes) -> Any:
    """The value that `packed` made bytes of.

    Raises
    ------
    UnknownClassError
        The bytes name another class than values consist of.
    """
    return _KnownClasses(io.BytesIO(content)).load()
