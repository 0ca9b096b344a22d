"""Checks of what Python callers pass to the functions of `zlocus`: each refuses a value in one sentence.

They look at the kind of a value. Whether a value of the right kind makes sense is checked where it is used, by
`zlocus.core.requests` and the stages.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS

from zlocus.core.errors import ConfigError, InputError
from zlocus.core.sensor_model import FloatArray

T = TypeVar("T")
BOUNDS, HEIGHTS = "xmin, ymin, xmax, ymax", "zmin, zmax"


def input_paths(function: str, inputs: tuple[Any, ...]) -> tuple[Path, ...]:
    """The inputs of a function as paths. function : its name, for messages.

    Raises
    ------
    InputError
        An input is a list of paths, an array, or anything else that is no path.
    """
    for number, value in enumerate(inputs, 1):
        if _is_path(value):
            continue
        what = f"Input {number} of {function} is {kind_of(value)}"
        if not hasattr(value, "__array__") and not isinstance(value, bytes) and isinstance(value, Iterable):
            raise InputError(f"{what}, and every image is an argument of its own. Give {function}(*paths).")
        raise InputError(
            f"{what}, and images are read from files, because their cameras are needed too. Give the paths of two "
            "images or more with RPC, or of one scene.yaml."
        )
    return tuple(Path(value) for value in inputs)


def path_of(name: str, value: Any, of: str = "file") -> Path:
    """An argument that is a path. name : of the argument; of : what it names, for the message.

    Raises
    ------
    ConfigError
        It is no path.
    """
    if not _is_path(value):
        raise ConfigError(f"{name} is {kind_of(value)}. Give the path of a {of}, as text or a pathlib.Path.")
    return Path(value)


def path_or_none(name: str, value: Any, of: str = "file") -> Path | None:
    """The same, where None is allowed."""
    return None if value is None else path_of(name, value, of)


def number_or_none(name: str, value: Any) -> float | None:
    """An argument that is a number or None.

    Raises
    ------
    ConfigError
        It is neither.
    """
    return None if value is None else float(_scalar(name, value, Real, "number"))


def count_or_none(name: str, value: Any) -> int | None:
    """An argument that is a whole number or None.

    Raises
    ------
    ConfigError
        It is neither.
    """
    return None if value is None else whole_number(name, value)


def whole_number(name: str, value: Any) -> int:
    """An argument that is a whole number.

    Raises
    ------
    ConfigError
        It is none.
    """
    return int(_scalar(name, value, Integral, "whole number"))


def _scalar(name: str, value: Any, kind: type[Any], noun: str) -> Any:
    """A value of a kind of numbers, to which truth values do not belong. noun : what to give."""
    if isinstance(value, bool | np.bool_) or not isinstance(value, kind):
        raise ConfigError(f"{name} is {kind_of(value)}. Give a {noun}.")
    return value


def bounds_or_none(value: Any) -> tuple[float, float, float, float] | None:
    """The argument `bounds`: four numbers in any sequence, or None.

    Raises
    ------
    ConfigError
        It is neither.
    """
    if value is None:
        return None
    xmin, ymin, xmax, ymax = _numbers("bounds", value, BOUNDS)
    return xmin, ymin, xmax, ymax


def heights_or_none(value: Any) -> tuple[float, float] | None:
    """The argument `heights`: two numbers in any sequence, or None.

    Raises
    ------
    ConfigError
        It is neither.
    """
    if value is None:
        return None
    zmin, zmax = _numbers("heights", value, HEIGHTS)
    return zmin, zmax


def _numbers(name: str, value: Any, meaning: str) -> tuple[float, ...]:
    n = meaning.count(",") + 1
    advice = f"Give {n} numbers: ({meaning})."
    if isinstance(value, str | bytes | dict | set) or not isinstance(value, Iterable):
        raise ConfigError(f"{name} is {kind_of(value)}. {advice}")
    values = list(value)
    if len(values) != n:
        raise ConfigError(f"{name} has {len(values)} values. {advice}")
    for each in values:
        is_array = bool(getattr(each, "shape", ()))
        if isinstance(each, bool | str | bytes) or is_array or not hasattr(each, "__float__"):
            raise ConfigError(f"{name} holds {kind_of(each)}. {advice}")
    return tuple(float(each) for each in values)


def text_or_none(name: str, value: Any) -> str | None:
    """An argument that is a text or None; a path counts as text.

    Raises
    ------
    ConfigError
        It is neither.
    """
    return None if value is None else text_of(name, value)


def text_of(name: str, value: Any) -> str:
    """An argument that is a text; a path counts as text.

    Raises
    ------
    ConfigError
        It is none.
    """
    if not _is_path(value):
        raise ConfigError(f"{name} is {kind_of(value)}. Give a text.")
    return str(value)


def names_of(name: str, value: Any) -> tuple[str, ...]:
    """An argument that is a sequence of names; a single text counts as names with commas between them.

    Raises
    ------
    ConfigError
        It is none.
    """
    if isinstance(value, str):
        return tuple(part.strip() for part in value.split(",") if part.strip() not in ("", "none"))
    if value is None or isinstance(value, bytes) or not isinstance(value, Iterable):
        raise ConfigError(f"{name} is {kind_of(value)}. Give a list of names, which may be empty.")
    return tuple(text_of(f"A value of {name}", each) for each in value)


def flag_of(name: str, value: Any) -> bool:
    """An argument that is True or False.

    Raises
    ------
    ConfigError
        It is neither.
    """
    if not isinstance(value, bool | np.bool_):
        raise ConfigError(f"{name} is {kind_of(value)}. Give True or False.")
    return bool(value)


def crs_or_none(value: Any) -> str | None:
    """The argument `crs` as text: a text, a CRS of pyproj or rasterio, or None.

    Raises
    ------
    ConfigError
        It is none of these.
    """
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, CRS):
        return value.to_string()
    to_wkt = getattr(value, "to_wkt", None)
    if not callable(to_wkt):
        raise ConfigError(f'crs is {kind_of(value)}. Give a text such as "EPSG:32632", or a pyproj.CRS.')
    return CRS.from_wkt(to_wkt()).to_string()


def instance_of(name: str, value: Any, kind: type[T], advice: str) -> T:
    """An argument that is of a class. advice : what to give, as a sentence.

    Raises
    ------
    ConfigError
        It is not.
    """
    if not isinstance(value, kind):
        raise ConfigError(f"{name} is {kind_of(value)}, not {_with_article(kind.__name__)}. {advice}")
    return value


def numeric_array(name: str, value: Any, axes: str) -> NDArray[Any]:
    """An argument that is an array of real numbers, as NumPy's. axes : names of its axes with commas between them.

    Raises
    ------
    ConfigError
        It holds no real numbers, or has another number of axes.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:  # rows of different lengths
        raise ConfigError(f"{name} is {kind_of(value)} that is no array. Give one of ({axes}).") from error
    if array.dtype.kind not in "fiu":
        raise ConfigError(f"{name} holds values of type {array.dtype}. Give real numbers in an array of ({axes}).")
    if array.ndim != axes.count(",") + 1:
        raise ConfigError(f"{name} has the shape {array.shape}. Give one of ({axes}).")
    return array


def positions(name: str, value: Any, axis: str) -> FloatArray:
    """An argument that is a list of finite numbers (n,), as float64. axis : its name.

    Raises
    ------
    ConfigError
        It is none.
    """
    array = np.asarray(numeric_array(name, value, axis), np.float64)
    if not np.isfinite(array).all():
        raise ConfigError(f"{name} holds values that are not finite. Give finite numbers.")
    return array


def positive_number(name: str, value: Any, unit: str) -> float:
    """An argument that is a finite number above 0.

    Raises
    ------
    ConfigError
        It is none.
    """
    number = number_or_none(name, value)
    if number is None or not (math.isfinite(number) and number > 0):
        raise ConfigError(f"{name} is {value}, which is no size. Give a number of {unit} above 0.")
    return number


def _is_path(value: Any) -> bool:
    return isinstance(value, str) or hasattr(value, "__fspath__")


def kind_of(value: Any) -> str:
    """What a value is, in words: "None", "a list of 3", "a NumPy array", "a DataArray"."""
    if value is None:
        return "None"
    if isinstance(value, list | tuple | set | dict):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, np.ndarray):
        return "a NumPy array"
    name = type(value).__name__
    shown = f" ({value!r})" if isinstance(value, bool | int | float | str | bytes) and len(repr(value)) <= 40 else ""
    return f"{_with_article(name)}{shown}"


def _with_article(name: str) -> str:
    return f"{'an' if name[0].lower() in 'aeiou' else 'a'} {name}"
