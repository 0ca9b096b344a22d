"""`zlocus inspect`: the page that explains a surface."""

from __future__ import annotations

import webbrowser
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from zlocus.cli.evaluate import Align, Coregister, Geoid, Margin
from zlocus.cli.report import check_about
from zlocus.core.errors import ConfigError

NEEDED = ("anyio", "starlette", "uvicorn")


def inspect(
    out: Annotated[Path, typer.Argument(help="Folder of a surface.", metavar="OUT")],
    reference: Annotated[Path | None, typer.Option(help="Reference heights to compare with.", metavar="RASTER")] = None,
    align: Align = False,
    coregister: Coregister = None,
    geoid: Geoid = None,
    margin: Margin = 0.0,
    remote: Annotated[bool, typer.Option("--remote", help="Ask servers for images that the run read there.")] = False,
    view: Annotated[
        str, typer.Option(help="Link of a view, or what stands behind its #, to begin with.", metavar="LINK")
    ] = "",
    host: Annotated[str, typer.Option(help="Address of this machine to answer at.", metavar="ADDRESS")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port. Default: one that is free.", min=0, max=65535, metavar="N")] = 0,
    open_it: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Look at a surface in the browser: click a cell, and see why it is as it is."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise ConfigError(
            f"The inspector needs {' and '.join(missing)}, not installed here: pip install '.[inspect]' in the clone."
        )
    check_about(reference, {"--align": align, "--coregister": coregister, "--geoid": geoid})
    from zlocus.inspector.serving import inspect_surface
    from zlocus.products.report.comparison import Comparison

    comparison = None
    if reference is not None:
        comparison = Comparison(reference, align=align, coregister=coregister, geoid=geoid, margin_m=margin)

    def announce(address: str, is_open_to_others: bool) -> None:
        if is_open_to_others:
            print("Whoever can reach this machine and knows this address can look at the surface and its images:")
        print(f"{address}\nOpen it in a browser; Ctrl-C ends it.", flush=True)
        if open_it:
            webbrowser.open(address)

    inspect_surface(out, comparison, remote, host, port, view, announce)
