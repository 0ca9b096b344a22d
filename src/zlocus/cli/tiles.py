"""`zlocus tiles`: a surface made by independent processes, such as the tasks of an array job."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from zlocus.cli.answer import Answer
from zlocus.cli.commands import Command, command_of, config_of
from zlocus.cli.console import Console
from zlocus.cli.dsm import DsmOptions, dsm_request
from zlocus.cli.help_text import EXAMPLES, GroupedHelp, short_help
from zlocus.cli.shared_options import INPUTS, Partial
from zlocus.core.errors import ConfigError

OUT_HELP = "Folder for the result, which all processes see."
OutArgument = Annotated[Path, typer.Argument(help=OUT_HELP, metavar="OUT")]
# Options of `zlocus dsm` that say who does the work: here each task is a process, with workers of its own.
WITHOUT = ("inputs", "out", "workers", "scheduler", "dry_run")

tiles = typer.Typer(
    name="tiles",
    help="Make a surface by independent processes, such as the tasks of an array job: plan, run every task, assemble.",
    no_args_is_help=True,
    rich_markup_mode=None,
)


def _plan_options() -> type[Any]:
    """The options of `zlocus tiles plan`: those of `zlocus dsm` for the surface, and the number of tasks."""
    hints = get_type_hints(DsmOptions, include_extras=True)
    inputs = typer.Argument(help=f"{INPUTS} None: say what is done of the plan in OUT.", metavar="INPUT")
    tasks = typer.Option(help="Tasks to deal the tiles into. Default: one for each tile.", metavar="K")
    own: list[Any] = [
        ("out", OutArgument),
        ("inputs", Annotated[list[Path] | None, inputs], field(default=None)),
        ("tasks", Annotated[int | None, tasks], field(default=None)),
    ]
    shared = [(f.name, hints[f.name], field(default=f.default)) for f in fields(DsmOptions) if f.name not in WITHOUT]
    return make_dataclass("TilesPlanOptions", [*own, *shared], frozen=True)


TilesPlanOptions = _plan_options()


def plan(options: Any, console: Console) -> Answer:
    """Plan a surface in tasks, numbered from 1 to K: open and orient the images once, and store in OUT what the tasks
    need. OUT alone says which tasks are done, and which are left.
    """
    if not options.inputs:
        given = [f.name for f in fields(options)[2:] if getattr(options, f.name) != f.default]
        if given:
            raise ConfigError(
                f"--{given[0].replace('_', '-')} is about a new plan, and no input is named. Name the images or the "
                "scene file, or leave the option out."
            )
        from zlocus.pipeline.array_jobs import state_or_finished

        state = state_or_finished(options.out)
        return Answer(str(state), state.as_dict(), is_asked_for=True)
    values = {f.name: getattr(options, f.name) for f in fields(DsmOptions) if f.name not in WITHOUT}
    request = dsm_request(DsmOptions(inputs=options.inputs, out=options.out, **values))
    config = config_of(options.config, options.settings)
    from zlocus.pipeline.array_jobs import plan_tasks

    state = plan_tasks(request, config, options.tasks, console.progress)
    return Answer(str(state), state.as_dict())


@dataclass(frozen=True)
class TilesRunOptions:
    """Arguments and options of `zlocus tiles run`."""

    out: OutArgument
    number: Annotated[int, typer.Argument(help="Number of the task, from 1 to K.", metavar="N")]
    workers: Annotated[int, typer.Option(help="Tiles worked on at a time, each on a core.", metavar="N")] = 1


def run(options: TilesRunOptions, console: Console) -> Answer:
    """Make the tiles of one task, in any order and on any machine that sees OUT. It may be killed and given again."""
    from zlocus.pipeline.array_jobs import run_task

    done = run_task(options.out, options.number, options.workers, console.progress)
    values = {"task": done.number, "tiles": done.n_tiles, "made": done.n_made, "was_finished": done.n_made == 0}
    return Answer(f"{options.out}: {done}", values)


@dataclass(frozen=True)
class TilesAssembleOptions:
    """Arguments and options of `zlocus tiles assemble`."""

    out: OutArgument
    partial: Partial = False


def assemble(options: TilesAssembleOptions, console: Console) -> Answer:
    """Write the surface of all tasks, with the files that `zlocus dsm` writes, and remove the tiles."""
    from zlocus.pipeline.array_jobs import assemble_tasks

    result = assemble_tasks(options.out, options.partial, console.progress)
    return Answer(
        result.sentence,
        {**result.as_dict(), "notes": console.notes},
    )


COMMANDS: tuple[tuple[str, type[Any], Command[Any]], ...] = (
    ("plan", TilesPlanOptions, plan),
    ("run", TilesRunOptions, run),
    ("assemble", TilesAssembleOptions, assemble),
)
for name, options, command in COMMANDS:
    full_name = f"tiles {name}"
    tiles.command(name, cls=GroupedHelp, epilog=EXAMPLES[full_name], short_help=short_help(command))(
        command_of(full_name, options, command)
    )
