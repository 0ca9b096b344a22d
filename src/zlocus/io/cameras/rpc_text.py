"""Read and write RPC side-car files: `_RPC.TXT` (key: value) and `.RPB` (key = value;).

Both count pixels as RPC00B does, with (0, 0) at the centre of the first pixel, so offsets are not shifted here.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.atomic_write import write_atomically
from zlocus.io.safe_text import (
    BYTE_ORDER_MARK,
    MAX_MAGNITUDE,
    decimal,
    digits_written,
    is_decimal,
    read_bytes,
    truncation_error,
)
from zlocus.sensors.rpc import RpcCoefficients

SCALARS = (
    "LINE_OFF", "SAMP_OFF", "LAT_OFF", "LONG_OFF", "HEIGHT_OFF",
    "LINE_SCALE", "SAMP_SCALE", "LAT_SCALE", "LONG_SCALE", "HEIGHT_SCALE",
)  # fmt: skip
POLYNOMIALS = ("LINE_NUM_COEFF", "LINE_DEN_COEFF", "SAMP_NUM_COEFF", "SAMP_DEN_COEFF")
TXT_NAMES = {*SCALARS, *(f"{name}_{i}" for name in POLYNOMIALS for i in range(1, 21))}
ADVICE = "Get the RPC from its source again."
# A real file has a hundredth of this.
MAX_RPC_BYTES = 1_000_000
# A smaller divisor counts as 0.
MIN_DIVISOR = 1e-12
RPB_NAMES = {
    "lineOffset": "LINE_OFF", "sampOffset": "SAMP_OFF", "latOffset": "LAT_OFF", "longOffset": "LONG_OFF",
    "heightOffset": "HEIGHT_OFF", "lineScale": "LINE_SCALE", "sampScale": "SAMP_SCALE", "latScale": "LAT_SCALE",
    "longScale": "LONG_SCALE", "heightScale": "HEIGHT_SCALE", "lineNumCoef": "LINE_NUM_COEFF",
    "lineDenCoef": "LINE_DEN_COEFF", "sampNumCoef": "SAMP_NUM_COEFF", "sampDenCoef": "SAMP_DEN_COEFF",
}  # fmt: skip


def read_rpc_txt(path: Path) -> RpcCoefficients:
    """The RPC of a `_RPC.TXT` file: `LINE_OFF: +018339.50 pixels`, `LINE_NUM_COEFF_1: ...`."""
    text, fields = _text(path), RpcFields(path)
    lines, above = text.splitlines(), set[tuple[int, int] | None]()
    for number, line in enumerate(lines, 1):
        name, _, rest = line.partition(":")
        if name.strip().upper() in TXT_NAMES:
            words = rest.split()
            # A unit may follow the number, but not another number.
            fields.add(name.strip().upper(), " ".join(words if len(words) > 1 and is_decimal(words[1]) else words[:1]))
            digits = digits_written(words[0]) if words else None
            is_ended = number < len(lines) or len(words) > 1 or text.endswith(("\n", "\r"))
            if not is_ended and (digits is None or {digits} != above):
                raise truncation_error(path, number)
            if "_COEFF" in name.upper():
                above.add(digits)
    for name in POLYNOMIALS:
        terms = [fields[key] for i in range(1, 21) if (key := f"{name}_{i}") in fields]
        if terms:
            fields[name] = " ".join(terms)
    return rpc_from_fields(fields, path)


def read_rpb(path: Path) -> RpcCoefficients:
    """The RPC of an `.RPB` file: `lineOffset = 18339;`, `lineNumCoef = (a, b, ...);`."""
    text = _text(path)
    specification = re.search(r'SpecId\s*=\s*"(\w+)"', text, re.IGNORECASE)
    if specification and specification[1].upper() != "RPC00B":
        raise InputError(
            f"{path} is an {specification[1]} model, of another term order. Only RPC00B is read; convert it."
        )
    fields = RpcFields(path)
    # Text behind the last semicolon is no complete statement.
    for statement in text.split(";")[:-1]:
        # The line that begins a group has no semicolon.
        before, _, value = statement.rpartition("=")
        name = (before.split() or [""])[-1]
        if name in RPB_NAMES:
            fields.add(RPB_NAMES[name], _listed(value.strip()))
    return rpc_from_fields(fields, path)


class RpcFields(dict[str, str]):
    """Fields of an RPC file by name. A field given twice with different values is refused."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def add(self, name: str, value: str) -> None:
        """Add a field.

        Raises
        ------
        InputError
            The field has another value already.
        """
        if self.setdefault(name, value) != value:
            raise InputError(f"{self.path}: {quoted(name)} of the RPC is there twice, with different values. {ADVICE}")


def _listed(value: str) -> str:
    """The numbers of "(a, b, ...)", or a single number, separated by blanks."""
    if value.startswith("(") and value.endswith(")"):
        value = value[1:-1].replace(",", " ")
    return value


def rpc_from_fields(fields: Mapping[str, str], path: Path) -> RpcCoefficients:
    """The coefficients from text fields, whose names are those of `_RPC.TXT`.

    Raises
    ------
    InputError
        A field is missing, not a finite number, a scale of 0, or has not 20 numbers. The message names file and field.
    """
    scalar = {name: _numbers(fields, name, 1, path)[0] for name in SCALARS}
    polynomial = {name: _numbers(fields, name, 20, path) for name in POLYNOMIALS}
    for name in SCALARS[5:]:
        if abs(scalar[name]) < MIN_DIVISOR:
            raise InputError(f"{path}: {name} of the RPC is {scalar[name]:g}. {ADVICE}")
    for name in ("LINE_DEN_COEFF", "SAMP_DEN_COEFF"):
        if abs(polynomial[name][0]) < MIN_DIVISOR:
            raise InputError(f"{path}: {name}_1 of the RPC is {polynomial[name][0]:g}, a pole at its centre. {ADVICE}")
    return RpcCoefficients(
        line_off=scalar["LINE_OFF"], samp_off=scalar["SAMP_OFF"],
        lat_off=scalar["LAT_OFF"], lon_off=scalar["LONG_OFF"], height_off=scalar["HEIGHT_OFF"],
        line_scale=scalar["LINE_SCALE"], samp_scale=scalar["SAMP_SCALE"],
        lat_scale=scalar["LAT_SCALE"], lon_scale=scalar["LONG_SCALE"], height_scale=scalar["HEIGHT_SCALE"],
        line_num=polynomial["LINE_NUM_COEFF"], line_den=polynomial["LINE_DEN_COEFF"],
        samp_num=polynomial["SAMP_NUM_COEFF"], samp_den=polynomial["SAMP_DEN_COEFF"],
    )  # fmt: skip


def write_rpc_txt(path: Path, rpc: RpcCoefficients) -> None:
    """Write an RPC as `_RPC.TXT`; `read_rpc_txt` reads back equal coefficients.

    Raises
    ------
    OutputError
        The file cannot be written.
    """
    units = ("pixels", "pixels", "degrees", "degrees", "meters") * 2
    scalars = (
        rpc.line_off, rpc.samp_off, rpc.lat_off, rpc.lon_off, rpc.height_off,
        rpc.line_scale, rpc.samp_scale, rpc.lat_scale, rpc.lon_scale, rpc.height_scale,
    )  # fmt: skip
    lines = [f"{name}: {value!r} {unit}" for name, value, unit in zip(SCALARS, scalars, units, strict=True)]
    for name, terms in zip(POLYNOMIALS, (rpc.line_num, rpc.line_den, rpc.samp_num, rpc.samp_den), strict=True):
        lines += [f"{name}_{i}: {value!r}" for i, value in enumerate(terms, 1)]
    write_atomically(path, lambda part: part.write_text("\n".join(lines) + "\n", encoding="ascii"))


def _numbers(fields: Mapping[str, str], name: str, count: int, path: Path) -> tuple[float, ...]:
    """The numbers of a field, checked: `count` of them, all finite."""
    text = fields.get(name, "").split()
    if not text:
        raise InputError(f"{path}: the RPC has no {name}. {ADVICE}")
    if len(text) != count:
        raise InputError(f"{path}: {name} of the RPC has {len(text)} numbers, not {count}. {ADVICE}")
    for number in text:
        if not abs(decimal(number)) <= MAX_MAGNITUDE:
            raise InputError(f"{path}: {name} of the RPC holds {quoted(number)}, not a finite number. {ADVICE}")
    return tuple(float(number) for number in text)


def _text(path: Path) -> str:
    content = read_bytes(path, MAX_RPC_BYTES).removeprefix(BYTE_ORDER_MARK)
    return content.decode("ascii", errors="replace")
