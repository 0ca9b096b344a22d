"""`zlocus paper`: tables and figures of Ji et al. (2014), one for each command, of the demo's block or of images."""

from __future__ import annotations

import shutil
from pathlib import Path

from zlocus.core.errors import OutputError
from zlocus.core.options import RunConfig
from zlocus.core.paper_request import BLOCK, BLOCK_RECORD, PaperRequest
from zlocus.core.progress import Progress
from zlocus.core.requests import SetupRequest, check_output
from zlocus.io.run_record import write_record
from zlocus.pipeline.demo_block import DIGEST, block_digest, is_block_of
from zlocus.pipeline.execution.precompile import kernels_compiling
from zlocus.pipeline.messages import note_orientation
from zlocus.pipeline.output_folder import made_folder
from zlocus.pipeline.paper_points import check_reference, find_point, paper_point, paper_space
from zlocus.pipeline.setup import open_inputs, orient_views, set_up_run
from zlocus.products.paper_figures import write_paper


def run_paper(request: PaperRequest, config: RunConfig, progress: Progress) -> str:
    """Make a table or figure of the paper, write its files to `request.out`, and return its values as text.

    Without inputs the block of the demo is rendered into the folder; commands that follow use it again.

    Raises
    ------
    InputError, ConfigError, GeometryError, OutputError
        An input that cannot be used, or a point that cannot be shown.
    """
    check_output(request.out, request.overwrite, request.files, request.what)
    with made_folder(request.out):
        inputs = request.inputs or demo_block(request.out, progress)
        setup_request = SetupRequest(
            inputs, crs=request.crs, resolution=request.resolution, heights=request.heights, reference=request.reference
        )
        with progress.stage("Opening images"):
            opened_inputs = open_inputs(setup_request, progress)
            check_reference(request, [view.name for view in opened_inputs.scene.views])
        orientation = orient_views(opened_inputs.scene, config.orientation, progress)
        note_orientation(orientation, progress, request.heights is not None)
        setup = set_up_run(setup_request, opened_inputs, orientation, config, progress)
        with progress.stage("Match curves"):
            space = paper_space(setup, request, config)
            area, point = find_point(space, request, config)
            shown = paper_point(space, area, point, request, config)
        with progress.stage("Writing"):
            return write_paper(request.out, request.what, shown)


def demo_block(out: Path, progress: Progress) -> tuple[Path, ...]:
    """The inputs of the demo's block in a folder, where it is rendered unless an earlier command has done so.

    Raises
    ------
    OutputError
        The folder holds another scene under that name.
    """
    from zlocus.synthetic.files import render_scene, scene_files
    from zlocus.synthetic.linescan import TrajectoryNoise
    from zlocus.synthetic.scenes import demo_spec

    spec, flown = demo_spec(), TrajectoryNoise()
    folder, record, digest = out / BLOCK, out / BLOCK_RECORD, block_digest(spec, flown)
    if folder.exists():
        if not record.exists():
            raise OutputError(f"{folder} is there already, and not the block of the demo. Choose another -o.")
        if is_block_of(record, digest):
            return scene_files(spec, folder, is_linescan=True).inputs
        shutil.rmtree(folder)
    with progress.stage("Rendering the demo's block", len(spec.views)) as stage, kernels_compiling(progress):
        rendered = render_scene(spec, folder, lambda step: stage.advance(), flown)
        write_record(record, {DIGEST: digest})
    return rendered.inputs
