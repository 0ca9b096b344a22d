"""The help of a command: its options in groups, and examples."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from itertools import groupby
from typing import Any

from typer.core import TyperCommand

from zlocus.cli.console import GROUP

# Options without a group of their own, in commands that have few of them.
OTHER = "Options"
# Lines of help are at most so wide, however wide the terminal is.
MAX_WIDTH = 110
EXAMPLES = {
    "demo": "zlocus demo -o demo",
    "dsm": """
        zlocus dsm img_1.tif img_2.tif img_3.tif -o surface --dry-run
        zlocus dsm img_1.tif img_2.tif img_3.tif -o surface --resolution 0.5
        zlocus dsm scene.yaml -o surface --dem dem.tif --products dtm
        """,
    "products": "zlocus products surface --products contours,dtm",
    "ortho": """
        zlocus ortho surface img_1.tif img_2.tif -o ortho
        zlocus ortho surface multispectral.tif -o ortho --no-mosaic
        """,
    "cloud": "zlocus cloud scene.yaml -o cloud --reference img_2 --fill interpolate",
    "rerun": "zlocus rerun surface/run.json -o again --inputs images",
    "curves": """
        zlocus curves scene.yaml --at 675350 4897120 -o curves
        zlocus curves img_1.tif img_2.tif --pixel img_1 250 240
        """,
    "paper": "zlocus paper figure3 -o paper",
    "orient": "zlocus orient scene.yaml -o oriented --control points.csv",
    "ties": "zlocus ties img_1.tif img_2.tif -o ties",
    "rank": "zlocus rank img_1.tif img_2.tif img_3.tif -o ranking",
    "doctor": """
        zlocus doctor img_1.tif img_2.tif
        zlocus doctor scene.yaml --bounds 675300 4897080 675420 4897170 -o checked
        """,
    "import": """
        zlocus import colmap sparse/0 -o scene.yaml --images photos
        zlocus import eo orientations.csv --crs EPSG:32632 --camera camera.yaml
        """,
    "export": """
        zlocus export colmap oriented -o for_colmap
        zlocus export rpc img_1.tif img_2.tif -o copies
        zlocus export mesh surface -o mesh
        """,
    "evaluate": """
        zlocus evaluate surface/dsm.tif reference.tif
        zlocus evaluate surface/dsm.tif srtm.tif --geoid egm96 --align -o judged
        zlocus evaluate surface/dsm.tif check_points.csv --points-crs EPSG:25832 --points-sigma 0.02
        """,
    "align": """
        zlocus align surface laser.laz -o aligned
        zlocus align surface atl08.csv -o aligned --tilt
        """,
    "compare": "zlocus compare surface other -o comparison",
    "mosaic": """
        zlocus mosaic north south -o joined
        zlocus mosaic strip_1 strip_2 lidar.tif=0.1 -o joined --feather 40
        """,
    "change": """
        zlocus change spring autumn -o changed
        zlocus change spring autumn -o changed --area pits.gpkg --name pit
        """,
    "report": "zlocus report surface --reference reference.tif",
    "inspect": "zlocus inspect surface --open",
    "config": "zlocus config -o options.toml",
    "docs": "zlocus docs how-to/deliveries",
    "tiles plan": """
        zlocus tiles plan surface img_1.tif img_2.tif --tasks 100
        zlocus tiles plan surface
        """,
    "tiles run": "zlocus tiles run surface 17",
    "tiles assemble": "zlocus tiles assemble surface",
}


class GroupedHelp(TyperCommand):
    """A command whose help shows the options in groups, each under the heading that the options name.

    Arguments have one form: NAME, [NAME] where it may be left out, NAME... where there may be several.
    """

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """The words of the line of usage: options first, then the arguments."""
        arguments = [param for param in self.get_params(ctx) if param.param_type_name == "argument"]
        return ["[OPTIONS]", *(_usage_of(param, ctx) for param in arguments)]

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the arguments, and the options group by group, in the order in which groups first appear."""
        shown = [param for param in self.get_params(ctx) if param.get_help_record(ctx) is not None]
        headings = list(dict.fromkeys(_heading(param) for param in shown))
        shown.sort(key=lambda param: headings.index(_heading(param)))
        for heading, params in groupby(shown, _heading):
            with formatter.section(heading):
                formatter.write_dl([_record(param, ctx) for param in params])

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples, a line each."""
        if self.epilog:
            with formatter.section("Examples"):
                for line in inspect.cleandoc(self.epilog).splitlines():
                    formatter.write(f"{' ' * formatter.current_indent}{line}\n")


def _heading(param: Any) -> str:
    """The heading of the group that a parameter belongs to."""
    if param.param_type_name == "argument":
        return "Arguments"
    return GROUP if param.name == "help" else getattr(param, "rich_help_panel", None) or OTHER


def _usage_of(param: Any, ctx: Any) -> str:
    """An argument in the line of usage."""
    name = f"{_record(param, ctx)[0]}{'...' if param.nargs == -1 else ''}"
    return name if param.required else f"[{name}]"


def _record(param: Any, ctx: Any) -> tuple[str, str]:
    """Name and meaning of a parameter; that of an argument without its type in Python."""
    name, meaning = param.get_help_record(ctx)
    return (name.partition(" <")[0] if param.param_type_name == "argument" else name), meaning


def short_help(run: Callable[..., Any]) -> str:
    """The first paragraph of a command's help, which stands in the list of all commands."""
    paragraph, *_ = inspect.cleandoc(run.__doc__ or "").split("\n\n")
    return " ".join(paragraph.split())
