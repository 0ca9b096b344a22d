"""`zlocus inspect`: the page that explains a surface."""

from __future__ import annotations

import webbrowser
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Annotated

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.console import Console
from zlocus.cli.evaluate import Align, Coregister, Geoid, Margin
from zlocus.cli.report import check_reference
from zlocus.cli.shared_options import Reference, SurfaceFolderArgument
from zlocus.core.errors import ConfigError

NEEDED = ("anyio", "starlette", "uvicorn")


@dataclass(frozen=True)
class InspectOptions:
    """Arguments and options of `zlocus inspect`."""

    out: SurfaceFolderArgument
    reference: Reference = None
    align: Align = False
    coregister: Coregister = None
    geoid: Geoid = None
    margin: Margin = 0.0
    remote: Annotated[bool, typer.Option("--remote", help="Allow reading of images that lie on servers.")] = False
    view: Annotated[
        str, typer.Option(help="Start with a view copied from the address of the page.", metavar="LINK")
    ] = ""
    host: Annotated[
        str, typer.Option(help="Address of this machine at which the page is served.", metavar="ADDRESS")
    ] = "127.0.0.1"
    port: Annotated[int, typer.Option(help="Port; 0 takes a free one.", min=0, max=65535, metavar="N")] = 0
    open_it: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False


def inspect(options: InspectOptions, console: Console) -> None:
    """Look at a surface in the browser, cell by cell."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise ConfigError(
            f"The inspector needs {' and '.join(missing)}, not installed here: pip install {' '.join(missing)}."
        )
    check_reference(
        options.reference,
        {"--align": options.align, "--coregister": options.coregister, "--geoid": options.geoid},
    )
    from zlocus.evaluation.comparison import Comparison
    from zlocus.inspector.serving import inspect_surface

    comparison = None
    if options.reference is not None:
        comparison = Comparison(
            options.reference, align=options.align, coregister=options.coregister, geoid=options.geoid,
            margin_m=options.margin,
        )  # fmt: skip

    def announce(address: str, is_open_to_others: bool) -> None:
        text = f"{address}\nOpen it in a browser; Ctrl-C ends it."
        if is_open_to_others:
            warning = "Whoever can reach this machine and knows this address can look at the surface and its images:"
            text = f"{warning}\n{text}"
        console.answer(Answer(text, {"address": address}, is_asked_for=True))
        if options.open_it:
            webbrowser.open(address)

    inspect_surface(
        options.out, comparison, options.remote, options.host, options.port, options.view, announce
    )  # fmt: skip
