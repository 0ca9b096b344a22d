"""The demo: the built-in scene rendered, matched, and judged by its truth."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from zlocus.core.errors import OutputError
from zlocus.core.options import RunConfig
from zlocus.core.progress import Progress
from zlocus.core.requests import DEMO_ACCURACY, DEMO_BEGUN, FINISHED, DsmRequest, held_files
from zlocus.io.run_record import write_record
from zlocus.pipeline.demo_block import DIGEST, block_digest, is_block_of
from zlocus.pipeline.dsm import run_dsm
from zlocus.pipeline.execution.checkpoint import FOLDER as TILES
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.pipeline.output_folder import made_folder
from zlocus.products.demo_figure import picture_beside_truth

if TYPE_CHECKING:
    from zlocus.evaluation.evaluate import Evaluation
    from zlocus.synthetic.files import RenderedScene
    from zlocus.synthetic.scenes import SceneSpec

DEMO_WORKERS = 2


@dataclass(frozen=True)
class DemoResult:
    """Result of the demo.

    out : folder of the products; evaluations : against the truth, within two ground pixels and within 1 m.
    """

    out: Path
    evaluations: tuple[Evaluation, ...]


def run_demo(out: Path, progress: Progress) -> DemoResult:
    """Render the built-in block (line scanners, six images in two strips), match it, and compare it with its truth.

    An interrupted demo resumes with its scene and its finished tiles; a finished demo starts anew.

    Raises
    ------
    OutputError
        Where `out` holds a scene that no demo has rendered.
    """
    from zlocus.evaluation.comparison import Comparison
    from zlocus.evaluation.evaluate import evaluate
    from zlocus.synthetic.scenes import LEVEL_1_M, demo_spec

    spec = demo_spec()
    rendered = _demo_scene(spec, out, progress)
    request = DsmRequest(inputs=rendered.inputs, out=out, resolution=spec.gsd_m, workers=DEMO_WORKERS)
    result = run_dsm(request, RunConfig(), progress)
    evaluations = (
        evaluate(
            result.out / "dsm.tif",
            Comparison(rendered.truth_dsm, rendered.truth_class, margin_m=0.0, threshold_m=limit),
        )
        for limit in (2 * LEVEL_1_M, 1.0)
    )
    picture_beside_truth(result.out / "dsm.tif", rendered.truth_dsm, result.out / "demo.png")
    return DemoResult(result.out, tuple(evaluations))


def _demo_scene(spec: SceneSpec, out: Path, progress: Progress) -> RenderedScene:
    """The scene of an interrupted demo, whose tiles stay; else a newly rendered scene."""
    from zlocus.synthetic.files import render_scene, scene_files
    from zlocus.synthetic.linescan import TrajectoryNoise

    # The trajectory files describe the flight exactly as it was rendered.
    flown = TrajectoryNoise()
    made_of = block_digest(spec, flown)
    folder, begun, finished = out / "scene", out / DEMO_BEGUN, out / DEMO_ACCURACY
    if folder.exists() and not finished.exists():
        if not begun.exists():
            raise OutputError(f"{folder} is there already, and not the scene of a demo. Choose another folder with -o.")
        if is_block_of(begun, made_of):
            progress.note(f"The scene in {folder} is that of a demo which was stopped: it is not rendered again.")
            return scene_files(spec, folder, is_linescan=True)
    with made_folder(out), progress.stage("Rendering the scene", len(spec.views)) as stage, kernels_compiling(progress):
        # From here on the folder belongs to a demo whose scene is not complete.
        write_record(begun, {})
        finished.unlink(missing_ok=True)
        for name in (FINISHED, *held_files(out)):
            (out / name).unlink(missing_ok=True)
        for old in (folder, out / TILES):
            shutil.rmtree(old, ignore_errors=True)
        rendered = render_scene(spec, folder, lambda step: stage.advance(), flown)
        write_record(begun, {DIGEST: made_of})
    return rendered
