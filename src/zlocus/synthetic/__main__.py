"""`python -m zlocus.synthetic -o FOLDER`: render a scene with its truth."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from zlocus.core.errors import ConfigError, ZlocusError

if TYPE_CHECKING:
    from zlocus.synthetic.scenes import SceneSpec


def main(arguments: list[str] | None = None) -> int:
    """Render the scene that the command line describes, and return the exit status."""
    from zlocus.synthetic.delivered import deliver
    from zlocus.synthetic.drone_block import DroneBlockSpec, render_drone_block, small_drone_block_spec
    from zlocus.synthetic.drone_projects import write_projects
    from zlocus.synthetic.files import render_scene
    from zlocus.synthetic.linescan import TrajectoryNoise
    from zlocus.synthetic.mixed import render_mixed_scene

    given = _parser().parse_args(arguments)
    try:
        _check(given)
        if given.kind == "mixed":
            render_mixed_scene(_spec(given), given.output, _say)
        elif given.kind in ("drone", "small-drone"):
            make_block = small_drone_block_spec if given.kind == "small-drone" else DroneBlockSpec
            block = make_block(seed=given.seed)
            rendered = render_drone_block(block, given.output, _say)
            if given.projects:
                write_projects(block, rendered)
        elif given.delivery:
            spec = _spec(given)
            deliver(spec, render_scene(spec, given.output, _say))
        else:
            linescan = TrajectoryNoise(*given.trajectory_noise) if given.cameras == "linescan" else None
            render_scene(_spec(given), given.output, _say, linescan)
    except ZlocusError as error:
        print(f"Error: {error}", file=sys.stderr)
        return error.exit_status
    return 0


def _check(given: argparse.Namespace) -> None:
    """Refuse options that would have no effect."""
    is_drone = given.kind in ("drone", "small-drone")
    if given.delivery and (is_drone or given.kind == "mixed" or given.cameras == "linescan"):
        raise ConfigError(
            "--delivery writes satellite images with RPCs. Leave it out, or choose another --kind and --cameras rpc."
        )
    if given.projects and not is_drone:
        raise ConfigError("--projects writes the cameras of a drone block. Add --kind small-drone, or leave it out.")


def _say(step: str) -> None:
    print(f"rendering {step}", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m zlocus.synthetic", description="Render a scene with exact truth.")
    parser.add_argument("-o", "--output", type=Path, required=True, help="new folder for images and truth")
    parser.add_argument(
        "--kind", choices=("city", "hills", "real", "dates", "demo", "mixed", "drone", "small-drone"),
        default="city",
        help="real: as hard as real images; dates: 19 images of as many days, or --views; drone: 20 frames of 12 Mpx; "
        "small-drone: 6 small ones (both: --seed only); mixed: ground like that of the demo, seen by three kinds of "
        "sensor (uses --seed and --size)",
    )  # fmt: skip
    parser.add_argument("--trouble", metavar="NAME", help="paint one trouble into a town: lake, glitter, snow ...")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--size", type=int, help="side of the area with truth, in ground pixels")
    parser.add_argument("--views", type=int, help="render only the first N views")
    parser.add_argument("--delivery", action="store_true", help="write the images as a vendor ships them (with RPCs)")
    parser.add_argument(
        "--projects", action="store_true", help="write the cameras as OpenDroneMap and COLMAP do (drone, small-drone)"
    )
    parser.add_argument("--pointing", type=float, default=0.0, metavar="PX", help="largest pointing error of the RPCs")
    parser.add_argument(
        "--cameras", choices=("rpc", "linescan"), default="rpc",
        help="RPCs, or a scene.yaml with the focal plane and trajectories of an ADS40",
    )  # fmt: skip
    parser.add_argument(
        "--trajectory-noise", type=float, nargs=2, default=(0.0, 0.0), metavar=("M", "DEG"),
        help="standard deviation of the slow errors of trajectories",
    )  # fmt: skip
    parser.add_argument(
        "--steady", action="store_true", help="line scanners: a flight that does not shake (always so with RPCs)"
    )
    parser.add_argument(
        "--level", type=int, choices=(0, 1), help="line scanners: 0 raw images, 1 images resampled to a plane"
    )
    return parser


def _spec(given: argparse.Namespace) -> SceneSpec:
    """The scene that the command line describes."""
    from zlocus.synthetic.many_dates import N_IMAGES, many_dates_spec
    from zlocus.synthetic.realistic import realistic_spec
    from zlocus.synthetic.scenes import (
        LARGE_SIZE,
        city_spec,
        demo_spec,
        hills_spec,
        trouble_spec,
        with_ads40,
        with_pointing_errors,
    )

    make: dict[str, Callable[[int], SceneSpec]] = {
        "city": city_spec, "hills": hills_spec, "real": realistic_spec,
        "dates": lambda seed: many_dates_spec(seed, given.views or N_IMAGES),
    }  # fmt: skip
    spec = make.get(given.kind, demo_spec)(given.seed)
    if given.trouble:
        spec = trouble_spec(given.trouble, given.seed)
    if given.kind == "mixed":
        return replace(spec, size=given.size or spec.size)
    if given.cameras == "linescan":
        spec = with_ads40(spec)
    if given.steady or given.cameras == "rpc":
        spec = replace(spec, shaken=False)
    if given.level is not None:
        spec = replace(spec, level=given.level)
    if given.size:
        coarse = spec.gsd_m if given.size > LARGE_SIZE else None
        spec = replace(spec, size=given.size, truth_step_m=coarse)
    if given.views:
        spec = replace(spec, views=spec.views[: given.views])
    return with_pointing_errors(spec, given.pointing) if given.pointing else spec


if __name__ == "__main__":
    sys.exit(main())
