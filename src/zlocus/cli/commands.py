"""Commands that take one options object: the fields of a dataclass become the options of the command line."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_type_hints

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console, OutputOptions
from zlocus.cli.exit_status import explained

if TYPE_CHECKING:
    from zlocus.core.options import RunConfig

Options = TypeVar("Options")
Command = Callable[[Options, Console], Answer | None]


def command_of(name: str, options: type[Options], run: Command[Options]) -> Callable[..., None]:
    """A function for Typer: each field of `options` is a parameter, and `run` gets them as one object.

    name : of the command; options : dataclass whose fields are annotated with Typer's arguments and options, to which
    those of `OutputOptions` are added; run : the command, whose docstring is its help text, and whose answer is
    printed; None where it has printed it already. Errors become one sentence and an exit status.
    """
    parameters = [*_parameters(options), *_parameters(OutputOptions)]

    def command(**values: Any) -> None:
        of_output = OutputOptions(**{field.name: values.pop(field.name) for field in fields(OutputOptions)})
        given = {"out": str(values["out"])} if values.get("out") is not None else {}
        plain_console = Console(name, OutputOptions(as_json=of_output.as_json), given)  # says what is wrong with others
        console = explained(Console, plain_console)(name, of_output, given)

        def answered() -> None:
            answer = run(options(**values), console)
            if answer is not None:
                console.answer(answer)
                if answer.exit_status:
                    raise typer.Exit(answer.exit_status)

        try:
            explained(answered, console)()
        finally:
            console.close()

    command.__name__, command.__doc__ = run.__name__, run.__doc__
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return command


def _parameters(options: type[Any]) -> list[inspect.Parameter]:
    """The fields of a dataclass as parameters of a function."""
    hints = get_type_hints(options, include_extras=True)
    return [
        inspect.Parameter(
            field.name,
            inspect.Parameter.KEYWORD_ONLY,
            default=inspect.Parameter.empty if field.default is MISSING else field.default,
            annotation=hints[field.name],
        )
        for field in fields(options)
    ]


def config_of(path: Path | None, settings: Sequence[str] | None) -> RunConfig:
    """The configuration in a file of --config, the default one without it, with the options of --set in place of it."""
    from zlocus.core.options import RunConfig
    from zlocus.io.settings import config_with_settings

    return config_with_settings(path, settings or ()) if path is not None or settings else RunConfig()
