"""Commands that take one options object: the fields of a dataclass become the options of the command line."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

from zlocus.cli.exit_status import explained

if TYPE_CHECKING:
    from zlocus.core.options import RunConfig

Options = TypeVar("Options")


def command_of(options: type[Options], run: Callable[[Options], None]) -> Callable[..., None]:
    """A function for Typer: each field of `options` is a parameter, and `run` gets them as one object.

    options : dataclass whose fields are annotated with Typer's arguments and options; run : the command, whose
    docstring is its help text. Errors become one sentence and an exit status.
    """
    hints = get_type_hints(options, include_extras=True)
    parameters = [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(options)  # type: ignore[arg-type]
    ]

    def command(**values: Any) -> None:
        run(options(**values))

    command.__name__, command.__doc__ = run.__name__, run.__doc__
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return explained(command)


def config_of(path: Path | None) -> RunConfig:
    """The configuration in a file of --config; the default one where none is given."""
    from zlocus.core.options import RunConfig
    from zlocus.io.config import read_config

    return RunConfig() if path is None else read_config(path)
