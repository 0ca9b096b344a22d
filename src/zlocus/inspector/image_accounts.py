"""What became of each image at a cell, in sentences: whether it agrees, is occluded or out-voted, and by what."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zlocus.core.options import RunConfig, large_window_side
from zlocus.core.options.option_fields import value_of
from zlocus.core.scene import View
from zlocus.core.sensor_model import FloatArray, lowest_station
from zlocus.inspector.folder import SurfaceFolder
from zlocus.inspector.profile import cells_of, values_at
from zlocus.io.open_raster import cached_raster
from zlocus.matching.image_votes import ImageVote, Vote, votes_of_images
from zlocus.matching.masked_cells import images_hidden_at
from zlocus.matching.match_scene import MatchScene
from zlocus.matching.occluders import Occluder, occluder_of
from zlocus.matching.occlusion import EDGE_PX, MANY_VIEWS, PAIR
from zlocus.matching.point_match import Place, PlaceCurves

COMPASS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
# Kinds of accounts in the order of the summary, with the words of one image and of several.
KINDS = {
    "agrees": ("agrees", "agree"), "undecided": ("cannot tell the height", "cannot tell the height"),
    "occluded": ("is occluded", "are occluded"), "out-voted": ("is out-voted", "are out-voted"),
    "overruled": ("is overruled", "are overruled"),
    "not chosen": ("is not chosen", "are not chosen"), "masked": ("is masked", "are masked"),
    "not compared": ("is not compared", "are not compared"), "outside": ("does not show it", "do not show it"),
}  # fmt: skip
UNLIMITED_M = math.inf
# A cell and the eight around it. The matching erodes a surface by them before it occludes others.
NEIGHBOURS = np.array([(0, 0), *((r, c) for r in (-1, 0, 1) for c in (-1, 0, 1) if (r, c) != (0, 0))])


@dataclass(frozen=True)
class LookedAtCell:
    """A cell that is looked at.

    place : with its ellipsoidal height; undulation_m : of the vertical datum there; place_curves : its match, None
    where fewer than two images show it; match_scene : without images that are switched off.
    """

    folder: SurfaceFolder
    match_scene: MatchScene
    config: RunConfig
    place: Place
    undulation_m: float
    place_curves: PlaceCurves | None

    @property
    def digits(self) -> int:
        """Decimals of heights and places, which show a tenth of a cell."""
        return max(1, math.ceil(-math.log10(self.folder.cell_m) - 1e-9) + 1)

    def metres(self, height_m: float) -> str:
        """An ellipsoidal height in the vertical datum of the surface, with its unit."""
        return f"{height_m - self.undulation_m:.{self.digits}f} m"


def image_accounts(cell: LookedAtCell) -> list[dict[str, Any]]:
    """What became of every image whose ground is near a cell.

    Keys of each record: image; kind, see `KINDS`; says, sentences; occluder: None, or the x, y and height_m of the
    surface that occludes the cell, its distance_m, and the lowest_visible_m, in the vertical datum of the surface.
    """
    place, match_scene = cell.place, cell.match_scene
    views = [match_scene.views[number] for number in match_scene.views_near(place.xyz[None, :2])]
    half = large_window_side(cell.config.cost) // 2
    masked = set(images_hidden_at(match_scene, place.xyz, half))
    accounts: dict[str, dict[str, Any]] = {}
    occluders: dict[str, Occluder] = {}
    for view in views:
        beside = _beside(view, place.xyz, half)
        if beside is not None:
            accounts[view.name] = _record(view, "outside", beside)
        elif view.name in masked:
            accounts[view.name] = _record(view, "masked", f"The mask of {view.name} covers the cell.")
        elif (occluder := _occluder(cell, view)) is not None:
            occluders[view.name] = occluder
    votes = _votes(cell, occluders)
    for view in views:
        if view.name in occluders:
            accounts[view.name] = _occluded(cell, view, occluders[view.name], len(votes))
        elif view.name not in accounts:
            accounts[view.name] = _account_of_vote(cell, view, votes)
    return [accounts[view.name] for view in views]


def summary_of(accounts: Sequence[dict[str, Any]], n_images: int) -> str:
    """How many images agree at a cell, and what became of the others, in a sentence. n_images : of the surface."""
    count = {kind: sum(account["kind"] == kind for account in accounts) for kind in KINDS}
    count["outside"] += n_images - len(accounts)
    parts = [f"{n} {KINDS[kind][n > 1]}" for kind, n in count.items() if n]
    *first, last = parts
    return f"Of {n_images} images {', '.join(first)}{' and ' if first else ''}{last}."


def _record(view: View, kind: str, says: str, occluder: dict[str, float] | None = None) -> dict[str, Any]:
    return {"image": view.name, "kind": kind, "says": says, "occluder": occluder}


def _beside(view: View, xyz: FloatArray, half: int) -> str | None:
    """Why an image does not show a ground point with the window around it; None where it does."""
    col, row = view.sensor.image_from_ground(xyz[None])[0]
    rows, cols = view.image.shape
    if not (math.isfinite(col) and math.isfinite(row)):
        return f"{view.name} does not show the cell. Its camera does not look there."
    beyond = {"left": -col, "right": col - (cols - 1), "upper": -row, "lower": row - (rows - 1)}
    side = max(beyond, key=lambda name: beyond[name])
    if beyond[side] > 0:
        return f"{view.name} does not show the cell, which lies {beyond[side]:.0f} px beyond its {side} edge."
    if beyond[side] > -(half + EDGE_PX):
        return (
            f"{view.name} shows the cell {-beyond[side]:.0f} px from its {side} edge. The window around the cell "
            "reaches beyond the pixels that are used."
        )
    return None


def _occluder(cell: LookedAtCell, view: View, is_eroded: bool = False) -> Occluder | None:
    """What of the surface occludes a cell from a view. is_eroded : erode the surface first, as the matching does."""
    folder, undulation_m = cell.folder, cell.undulation_m

    def heights_at(xy: FloatArray) -> FloatArray:
        cells = cells_of(folder, xy)
        around = cells[None] + (NEIGHBOURS if is_eroded else NEIGHBOURS[:1])[:, None]
        z = values_at(folder, "dsm", around.reshape(-1, 2)).reshape(around.shape[:2])
        return np.asarray(z.min(axis=0) + undulation_m)

    margin_m = value_of(cell.config.cost, "occlusion_margin_steps") * cell.match_scene.height_step
    top_m = min(_highest(folder) + undulation_m, cell.match_scene.z_range[1])
    station_m = lowest_station([view.sensor])
    top_m = top_m if station_m is None else min(top_m, station_m)
    return occluder_of(view.sensor, cell.place.xyz, heights_at, top_m, folder.cell_m, margin_m)


def _highest(folder: SurfaceFolder) -> float:
    """Height of the highest cell of a surface, m; infinite where its file does not tell."""
    with cached_raster(folder.path("dsm")) as file:
        return float(file.tags(1).get("STATISTICS_MAXIMUM", UNLIMITED_M))


def _votes(cell: LookedAtCell, occluders: dict[str, Occluder]) -> dict[str, ImageVote | None]:
    """The votes of the images that are compared at a cell, by name. Where fewer than two see it, all take part."""
    place_curves = cell.place_curves
    if place_curves is None:
        return {}
    names = [view.name for view in place_curves.views]
    sees = np.array([name not in occluders for name in names])
    takes_part: NDArray[np.bool_] = sees if sees.sum() >= PAIR else np.ones(len(names), np.bool_)
    windows = place_curves.patches(large_window_side(cell.config.cost))
    votes = votes_of_images(windows, takes_part, len(place_curves.heights_m) // 2)
    return dict(zip(names, votes, strict=True))


def _occluded(cell: LookedAtCell, view: View, occluder: Occluder, n_compared: int) -> dict[str, Any]:
    """The account of an image from which the surface occludes a cell."""
    x, y, z = (float(value) for value in occluder.xyz)
    rise, digits = z - cell.place.xyz[2], cell.digits
    towards = "" if cell.folder.is_local else f" to the {_compass(*(occluder.xyz - cell.place.xyz)[:2])}"
    first, second = ("x", "y") if cell.folder.is_local else ("E", "N")
    if n_compared <= PAIR:
        fate = "Of two images none is left out, so it was compared all the same."
    elif n_compared >= MANY_VIEWS:
        fate = "Where so many images show a cell none is left out, but only the best pairs count."
    elif _occluder(cell, view, is_eroded=True) is not None:
        fate = "It is left out at this cell, unless too few images would be left."
    else:
        fate = (
            "Its ray passes close to an edge. The matching allows for an error of one cell there, and compares the "
            "image all the same."
        )
    says = (
        f"{view.name} is occluded. It shows the surface {occluder.distance_m:.{digits}f} m away{towards}, at {first} "
        f"{x:.{digits}f}, {second} {y:.{digits}f} m. The surface there is {cell.metres(z)} high, {rise:.{digits}f} m "
        f"above this cell. {view.name} sees this place only from a height of {cell.metres(occluder.lowest_visible_m)} "
        f"on. {fate}"
    )
    place = {
        "x": x, "y": y, "height_m": z - cell.undulation_m, "distance_m": occluder.distance_m,
        "lowest_visible_m": occluder.lowest_visible_m - cell.undulation_m,
    }  # fmt: skip
    return _record(view, "occluded", says, place)


def _compass(east: float, north: float) -> str:
    """The point of the compass to which an offset leads."""
    return COMPASS[round(math.degrees(math.atan2(east, north)) / 45) % 8]


def _account_of_vote(cell: LookedAtCell, view: View, image_votes: dict[str, ImageVote | None]) -> dict[str, Any]:
    """The account of an image that shows a cell and sees it."""
    name, place_curves = view.name, cell.place_curves
    if place_curves is None:
        return _record(view, "not compared", f"{name} shows the cell, but no other image does.")
    if name not in image_votes:
        limit = cell.config.selection.max_candidates
        n_showing = len(cell.match_scene.views_near(cell.place.xyz[None, :2]))
        if n_showing > limit + 1:
            why = f"Of {n_showing} images near it, {limit + 1} with better angles are compared (max_candidates)."
        else:
            why = "It has no grey values in the whole window around it."
        return _record(view, "not compared", f"{name} shows the cell, but is not compared. {why}")
    image_vote = image_votes[name]
    if image_vote is None:
        return _record(view, "not compared", f"{name} shows the cell, but no other image sees it.")
    peak = cell.metres(float(place_curves.heights_m[image_vote.peak]))
    own = f"Its mean correlation with the other images is {image_vote.correlation:.2f} here"
    most = f"{image_vote.at_peak:.2f}"
    others = (
        f"The other {image_vote.n_others} images agree here with {image_vote.others:.2f}, and there with "
        f"{image_vote.others_at_peak:.2f}."
    )
    says = {
        Vote.AGREES: f"{name} agrees. {own}.",
        Vote.UNDECIDED: f"{name} cannot tell the height. {own}, and {most} at most, at {peak}.",
        Vote.OUT_VOTED: f"{name} is out-voted. {own}. It would match best at {peak}, with {most}. {others}",
        Vote.OVERRULED: f"{name} is overruled. {own}, and {most} at {peak}. {_overruled_by(image_vote)}",
    }[image_vote.vote]
    why = _why_not_chosen(cell, place_curves, name)
    return _record(view, image_vote.vote.value, says) if not why else _record(view, "not chosen", f"{why} {says}")


def _why_not_chosen(cell: LookedAtCell, place_curves: PlaceCurves, name: str) -> str:
    """Why the rule of --selection guided does not choose an image for a cell; "" where it does, or the run has no such
    rule."""
    curves = place_curves.curves
    search = [place_curves.views[i].name for i in curves.order.search]
    is_guided = cell.folder.run["config"]["request"].get("selection") == "guided"
    if not is_guided or name not in search[curves.n_used :]:
        return ""
    rank = search.index(name)
    if not curves.order.is_helpful[rank]:
        labels = curves.order.accumulated[rank]
        return f"{name} is not chosen, because its labels at the tie points around sum to {labels:+d} only."
    enough = "no more images are allowed (max_images)"
    if curves.is_stopped:
        enough = "the mean of those before it is good enough"
    return f"{name} is not chosen. It comes at place {rank + 1} of the search images, and {enough}."


def _overruled_by(image_vote: ImageVote) -> str:
    """What puts the surface at another height than that at which an image matches best."""
    if math.isnan(image_vote.others):
        return "Two images cannot out-vote each other. The neighbouring cells decided."
    return (
        f"The other {image_vote.n_others} images do not agree better here ({image_vote.others:.2f}) than there "
        f"({image_vote.others_at_peak:.2f}). The neighbouring cells decided."
    )
