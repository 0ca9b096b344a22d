"""Validate documents with pydantic: unknown keys are refused at every level, and errors are one sentence."""

from __future__ import annotations

import reprlib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from zlocus.core.errors import InputError
from zlocus.core.quoting import quoted
from zlocus.io.safe_text import MAX_MAGNITUDE, is_decimal


def _plain(value: Any) -> Any:
    """Refuse what pydantic would accept as a number: true as 1, and the text 1_0 as 10."""
    if isinstance(value, bool) or (isinstance(value, str) and not is_decimal(value)):
        raise ValueError("is not a number")
    return value


FiniteNumber = Annotated[FiniteFloat, BeforeValidator(_plain), Field(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]
WholeNumber = Annotated[int, BeforeValidator(_plain), Field(ge=-MAX_MAGNITUDE, le=MAX_MAGNITUDE)]


class StrictModel(BaseModel):
    """Base class of documents: a frozen mapping that refuses unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, populate_by_name=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, value: Any) -> Any:
        allowed = {name: field.alias or name for name, field in cls.model_fields.items()}
        if isinstance(value, dict):
            unknown = [_key(key) for key in value if key not in allowed and key not in allowed.values()]
            if unknown:
                raise ValueError(f"unknown key {', '.join(unknown)[:80]}; allowed here: {', '.join(allowed.values())}")
        return value


# A message shows only the beginning of a large value.
SHORT = reprlib.Repr()
SHORT.maxlevel, SHORT.maxstring, SHORT.maxother = 2, 80, 80

Document = TypeVar("Document", bound=StrictModel)


def validate_document(model: type[Document], document: Any, path: Path, where: str = "") -> Document:
    """The document as an instance of `model`. path : its file; where : key of the document within the file.

    Raises
    ------
    InputError
        For the first fault: names the file, the key, its value and what is allowed.
    """
    empty = _empty_key(document)
    if empty is not None:
        place = f"{where}.{empty}" if where else empty
        raise InputError(f"{path}: {place} has no value. Give one, or leave the key out.")
    try:
        return model.model_validate(document)
    except ValidationError as error:
        first = error.errors()[0]
        key = where
        for part in first["loc"]:
            key += f"[{part}]" if isinstance(part, int) else f".{_key(part)}" if key else _key(part)
        if first["type"] == "missing":
            raise InputError(f"{path}: the key {key} is missing. Add it.") from error
        message = first["msg"].removeprefix("Value error, ")
        value = "" if isinstance(first["input"], dict) else f" (there: {SHORT.repr(first['input'])})"
        raise InputError(f"{path}: {key or 'the document'}: {message}{value}.") from error


def _empty_key(document: Any) -> str | None:
    """The first key of a document, with the keys that it is in, that has no value; None where there is none."""
    if not isinstance(document, dict):
        return None
    for key, value in document.items():
        if value is None:
            return _key(key)
        inside = _empty_key(value)
        if inside is not None:
            return f"{_key(key)}.{inside}"
    return None


def _key(key: Any) -> str:
    """A key for a message: on one line, and only the beginning of a long one."""
    text = str(key)
    return text if text.isprintable() and len(text) <= SHORT.maxstring else quoted(text)
