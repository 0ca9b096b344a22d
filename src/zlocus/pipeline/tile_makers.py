"""What makes the tiles of a surface: their matching on the ground grid, or heights of pixels matched before.

Modules of image space are imported where they are used: most runs match on the ground grid, and start sooner.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from zlocus.core.progress import Progress
from zlocus.core.requests import DsmRequest
from zlocus.orientation.tie_heights import supported
from zlocus.pipeline.execution.checkpoint import TileCheckpoint
from zlocus.pipeline.execution.plan import Tile
from zlocus.pipeline.execution.spill_arrays import SpillArrays
from zlocus.pipeline.run_plan import Plan
from zlocus.pipeline.setup import RunSetup, supported_views
from zlocus.pipeline.tile_run import Tally, TileJob, TileProduct

if TYPE_CHECKING:
    from zlocus.pipeline.image_tiles import GridImages, ImageMatching


def tile_maker(
    request: DsmRequest,
    tile_job: TileJob,
    checkpoint: TileCheckpoint,
    setup: RunSetup,
    plan: Plan,
    tally: Tally,
    progress: Progress,
) -> Callable[[Tile], TileProduct]:
    """The function that makes a tile of a surface.

    On the ground grid it is the tile_job itself. In image space all images are matched and checked against each other
    first, or with the selection of the paper the reference image alone; a tile is then made from their heights.
    """
    if not request.is_in_image_space:
        return tile_job
    from zlocus.pipeline.image_scenes import GroundArea
    from zlocus.pipeline.image_tiles import ImageMatching, grid_tile

    grid, match_scene = tile_job.grid, setup.match_scene
    box, margin = grid.geobox.extent.boundingbox, tile_job.config.pyramid.halo * grid.cell_m
    bounds = (box.left - margin, box.bottom - margin, box.right + margin, box.top + margin)
    spill_arrays = SpillArrays(request.out, plan.allowed_bytes - plan.n_bytes)
    area = GroundArea(bounds, setup.height_range.searched)
    matching = ImageMatching(tile_job.config, tile_job.method, plan.slots, spill_arrays, area, checkpoint)
    if request.selection == "paper":
        grid_images = heights_of_reference(setup, matching, progress)
    else:
        grid_images = heights_of_images(request, setup, matching, progress)
    tally.evaluations, tally.all_images = grid_images.evaluations, grid_images.all_images
    if spill_arrays.file_bytes:
        progress.note(
            f"Memory has no room for the heights of all pixels: {spill_arrays.file_bytes / 1e9:.2g} GB of them lie on "
            "disk."
        )

    def make(tile: Tile) -> TileProduct:
        product = tile_job.product(
            tile, grid_tile(grid_images, match_scene, tile.core_window, tile_job.config, tile_job.fill)
        )
        spill_arrays.rest()
        return product

    return make


def heights_of_images(request: DsmRequest, setup: RunSetup, matching: ImageMatching, progress: Progress) -> GridImages:
    """Heights of the pixels of all images, checked against each other."""
    from zlocus.pipeline.image_scenes import ImageSetup
    from zlocus.pipeline.image_tiles import heights_for_grid

    orientation = setup.orientation
    used = supported_views(setup.scene, orientation)
    is_supported = supported(orientation.xyz, orientation.sigma_z_m)
    image_setup = ImageSetup(used, orientation, orientation.xyz, is_supported, setup.height_range.searched)
    references = [view.name for view in setup.match_scene.views if request.reference in (None, view.name)]
    return heights_for_grid(image_setup, references, matching, progress)


def heights_of_reference(setup: RunSetup, matching: ImageMatching, progress: Progress) -> GridImages:
    """Heights of the pixels of the reference image alone, as GC3 finds them with the selection of the paper.

    No other image is matched, so none can contradict them.
    """
    from zlocus.pipeline.image_scenes import reference_scene
    from zlocus.pipeline.image_tiles import GridImages, match_images, pixel_heights

    assert matching.ground_area is not None, "a surface has an area"
    assert matching.ground_area.z_range is not None, "between two heights"
    (matched,) = match_images([reference_scene(setup, matching.config)], matching, progress)
    heights = pixel_heights(matched, matched, sum(matching.ground_area.z_range) / 2)
    # The flags of its pixels say already where fewer than two images show them. So the reference image stands for the
    # other one too, where `gridded` counts the images that show an empty cell.
    return GridImages([heights], [heights, heights], matched.evaluations, matched.all_images)
