"""The command line: options in, one sentence out for whatever goes wrong.

Each command has a file of its own. Heavy modules are imported inside the commands, so that `zlocus --help` answers at
once.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer

from zlocus import __version__
from zlocus.cli.align import AlignOptions, align
from zlocus.cli.answer import Answer
from zlocus.cli.change import ChangeOptions, change
from zlocus.cli.cloud import CloudOptions, cloud
from zlocus.cli.commands import Command, command_of
from zlocus.cli.compare import CompareOptions, compare
from zlocus.cli.config import ConfigOptions, config
from zlocus.cli.console import Console, OutputOptions
from zlocus.cli.curves import CurvesOptions, curves
from zlocus.cli.demo import DemoOptions, demo
from zlocus.cli.docs import DocsOptions, docs
from zlocus.cli.doctor import DoctorOptions, doctor
from zlocus.cli.dsm import DsmOptions, dsm
from zlocus.cli.evaluate import EvaluateOptions, evaluate
from zlocus.cli.exit_status import show_our_warnings
from zlocus.cli.export import ExportOptions, export
from zlocus.cli.help_text import EXAMPLES, MAX_WIDTH, GroupedHelp, short_help
from zlocus.cli.import_cameras import ImportOptions, import_cameras
from zlocus.cli.inspect import InspectOptions, inspect
from zlocus.cli.mosaic import MosaicOptions, mosaic
from zlocus.cli.orient import OrientOptions, TiesOptions, orient, ties
from zlocus.cli.ortho import OrthoOptions, ortho
from zlocus.cli.paper import PaperOptions, paper
from zlocus.cli.products import ProductsOptions, products
from zlocus.cli.rank import RankOptions, rank
from zlocus.cli.report import ReportOptions, report
from zlocus.cli.rerun import RerunOptions, rerun
from zlocus.cli.tiles import tiles
from zlocus.core.signals import handle_signals
from zlocus.core.startup import prepare

# Commands in the order in which `zlocus --help` lists them: name, options, function.
COMMANDS: tuple[tuple[str, type[Any], Command[Any]], ...] = (
    ("demo", DemoOptions, demo),
    ("dsm", DsmOptions, dsm),
    ("products", ProductsOptions, products),
    ("ortho", OrthoOptions, ortho),
    ("cloud", CloudOptions, cloud),
    ("rerun", RerunOptions, rerun),
    ("curves", CurvesOptions, curves),
    ("paper", PaperOptions, paper),
    ("orient", OrientOptions, orient),
    ("ties", TiesOptions, ties),
    ("rank", RankOptions, rank),
    ("doctor", DoctorOptions, doctor),
    ("import", ImportOptions, import_cameras),
    ("export", ExportOptions, export),
    ("evaluate", EvaluateOptions, evaluate),
    ("align", AlignOptions, align),
    ("compare", CompareOptions, compare),
    ("mosaic", MosaicOptions, mosaic),
    ("change", ChangeOptions, change),
    ("report", ReportOptions, report),
    ("inspect", InspectOptions, inspect),
    ("config", ConfigOptions, config),
    ("docs", DocsOptions, docs),
)

app = typer.Typer(
    name="zlocus",
    help="Digital surface models from images, by multi-view vertical line locus matching.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": MAX_WIDTH},
)
for name, options, run in COMMANDS:
    app.command(name, cls=GroupedHelp, epilog=EXAMPLES.get(name), short_help=short_help(run))(
        command_of(name, options, run)
    )
app.add_typer(tiles, short_help=tiles.info.help)


@app.callback(invoke_without_command=True)
def _options(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --version: print it as one JSON object.")] = False,
) -> None:
    """Options before the command."""
    if version:
        Console("", OutputOptions(as_json=as_json)).answer(Answer(f"zlocus {__version__}"))
        raise typer.Exit
    if as_json:
        raise typer.BadParameter("it goes with --version, or after the name of a command.", param_hint="--json")


def command_name(words: Sequence[str]) -> str:
    """The name of the command that words call, with that of its group."""
    n = 2 if words[:1] == [tiles.info.name] else 1
    return " ".join(word for word in words[:n] if not word.startswith("-"))


# What the library says of a value that cannot be used, and what we say.
WRONG_VALUES = {
    r"Input should be a valid integer.*|'.*' is not a valid int(eger)?\.": "a whole number is needed",
    r"Input should be a valid number.*|'.*' is not a valid float\.": "a number is needed",
    r"Input should be less than or equal to (\S+)": r"it must be \1 at most",
    r"Input should be greater than or equal to (\S+)": r"it must be \1 or more",
    r"Input should ": "it must ",
}


def in_our_words(message: str) -> str:
    """The message of a usage error, without the words of the library that checks types."""
    for theirs, ours in WRONG_VALUES.items():
        message = re.sub(theirs, ours, message)
    return message


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line and exit, in a process of its own; `arguments` default to those of the process."""
    handle_signals()
    prepare()
    show_our_warnings()
    words = sys.argv[1:] if arguments is None else list(arguments)
    try:
        status = app(words, prog_name="zlocus", standalone_mode=False)
    except Exception as error:
        # The class of usage errors is private in Typer; they know how to show themselves.
        usage: Any = error
        if not hasattr(error, "show"):
            raise
        usage.message = in_our_words(usage.message)
        usage.show()
        if "--json" in words:
            Console(command_name(words), OutputOptions(as_json=True)).failed(usage.format_message(), usage.exit_code)
        status = usage.exit_code
    sys.exit(status or 0)
