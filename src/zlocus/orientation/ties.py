"""Tie points: ground points seen in two or more images, found by SIFT and checked by the sensor models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product

import numpy as np
from numpy.typing import NDArray

from zlocus.core.errors import GeometryError
from zlocus.core.footprints import ground_box
from zlocus.core.options import OrientationOptions
from zlocus.core.parallel import run_all
from zlocus.core.scene import Scene, View, held_window
from zlocus.core.sensor_model import FloatArray, lowest_station
from zlocus.orientation.epipolar import EpipolarCurves, Sightlines, epipolar_curves, epipolar_offsets
from zlocus.orientation.kernels.descriptors import CurveSegments, SecondFeatures, nearest_descriptors
from zlocus.orientation.ransac import find_shift
from zlocus.orientation.sift import Features, detect_all, part_grid, parts, reduction
from zlocus.orientation.triangulate import Observations

Progress = Callable[[str, float], None]

# Largest descriptor distance of a match, as a share of that of the second-best match (Lowe 2004).
MAX_DESCRIPTOR_RATIO = 0.8
# Points along each side of a part of an image of which epipolar curves are computed, to see which images may show it.
PART_POINTS = 5
# Parts whose curves are in memory at once: those of an image of 64 000 px a side.
PARTS_AT_ONCE = 4096
# Features of the first search of a pair, which finds its shift.
FIRST_SEARCH_FEATURES = 1000
# Epipolar curves of cameras close to the ground are far from straight. Each is searched over ranges of heights whose
# depths differ by this ratio squared.
DEPTH_RATIO = 1.5
# Images without ties are searched again with a pointing error that is this many times larger, together with so many of
# the other images. Their ties count if they lead to at least so many images that are tied to each other.
WIDER_POINTING_FACTOR, MAX_PARTNERS, MIN_PARTNERS = 10.0, 6, 2


@dataclass(frozen=True)
class PairMatches:
    """Matches of two images that agree with the sensor models up to one shift.

    views : numbers of the two views; first, second : (k,) numbers of their features; z : (k,) height of each match, m;
    n_candidates : number of matches before RANSAC; shift_px : (2,) by which the second image's points lie off their
    epipolar curves.
    """

    views: tuple[int, int]
    first: NDArray[np.int64]
    second: NDArray[np.int64]
    z: FloatArray
    n_candidates: int
    shift_px: FloatArray

    def __len__(self) -> int:
        return len(self.first)


@dataclass(frozen=True)
class Ties:
    """Tie points of a scene.

    observations : their image points; z : (n,) m, first height of each tie; pairs : the matches from which they were
    built; z_range : lowest and highest height that were searched, m.
    """

    observations: Observations
    z: FloatArray
    pairs: tuple[PairMatches, ...]
    z_range: tuple[float, float]


def find_ties(
    scene: Scene,
    options: OrientationOptions,
    z_range_hint: tuple[float, float] | None = None,
    progress: Progress | None = None,
    threads: int = 1,
) -> Ties:
    """Tie points between all images that overlap. They do not depend on the number of threads.

    Ties are searched at heights within `z_range_hint` (m) where it is given, else within the scene's heights, else at
    all heights for which the sensor models were made. A pair with fewer than `min_ties` agreeing matches is dropped.
    """
    z_range = z_range_hint or scene.heights or widest_range(scene.views)
    report = progress or (lambda _stage, _share: None)
    z_ranges = height_slabs(scene.views, z_range)
    near = neighbours(scene.views, z_range, options.max_pointing_px)
    wanted = shared_parts(scene.views, z_ranges, options.max_pointing_px, near)
    images = [view.image for view in scene.views]
    features = detect_all(images, wanted, options, threads, lambda share: report("features", share))
    pairs: dict[int, list[PairMatches]] = {}

    def match_all(a: int) -> list[PairMatches]:
        """Match an image with all images after it, for which alone its sightlines are needed."""
        others = near[a][near[a] > a]
        if not len(others):
            return []
        lines = [Sightlines.of(scene.views[a].sensor, features[a].xy, z_range) for z_range in z_ranges]
        found = (match_pair(scene.views, features, (a, int(b)), lines, options) for b in others)
        return [matches for matches in found if len(matches)]

    n_pairs, done = sum(map(len, near)) // 2, 0
    for a, found in run_all(match_all, range(len(scene.views)), threads):
        pairs[a] = found
        done += int((near[a] > a).sum())
        report("matches", done / n_pairs if n_pairs else 1.0)
    every = tuple(pair for a in sorted(pairs) for pair in pairs[a])
    every += match_untied_images(scene.views, features, every, z_ranges, options)
    if len(z_ranges) > 1 and every:
        z_range = likely_range(np.concatenate([pair.z for pair in every]))
    return join_tracks(features, every, z_range)


def match_untied_images(
    views: Sequence[View],
    features: Sequence[Features],
    pairs: Sequence[PairMatches],
    z_ranges: Sequence[tuple[float, float]],
    options: OrientationOptions,
) -> tuple[PairMatches, ...]:
    """Matches of images that have no ties within the expected pointing error, from a search with a larger one.

    pairs : the matches so far. Along an epipolar curve a shift cannot be told from a height. So an image that is far
    off counts only where it ties to several others that are already tied to each other.
    """
    n_ties = np.zeros(len(views), np.int64)
    for pair in pairs:
        n_ties[list(pair.views)] += len(pair)
    tied = np.argsort(-n_ties, kind="stable")[: int((n_ties > 0).sum())]
    wide, found = replace(options, max_pointing_px=WIDER_POINTING_FACTOR * options.max_pointing_px), []
    for lost in np.flatnonzero(n_ties == 0).tolist():
        lines = [Sightlines.of(views[lost].sensor, features[lost].xy, z_range) for z_range in z_ranges]
        matches = [match_pair(views, features, (lost, int(b)), lines, wide) for b in tied[:MAX_PARTNERS]]
        matches = [pair for pair in matches if len(pair)]
        partners = {pair.views[1] for pair in matches}
        if len(partners) >= MIN_PARTNERS and any(partners >= set(pair.views) for pair in pairs):
            found += matches
    return tuple(found)


def height_slabs(views: Sequence[View], z_range: tuple[float, float]) -> list[tuple[float, float]]:
    """Overlapping ranges of heights (m) that cover `z_range`, in each of which epipolar curves are nearly straight.

    It is one range, except for cameras close to the ground.
    """
    station = lowest_station(view.sensor for view in views)
    if station is None:
        return [z_range]
    far, near = (station - z for z in z_range)
    if not near > 0 or far / near <= DEPTH_RATIO**2:
        return [z_range]
    n_slabs = int(np.ceil(np.log(far / near) / np.log(DEPTH_RATIO))) - 1
    depths = np.geomspace(far, near, n_slabs + 2)
    return [(station - float(depths[k]), station - float(depths[k + 2])) for k in range(n_slabs)]


def widest_range(views: Sequence[View]) -> tuple[float, float]:
    """Lowest and highest height (m) for which any of the views' sensor models was made."""
    bounds = [bound for view in views if (bound := view.sensor.height_bounds()) is not None]
    if not bounds:
        raise GeometryError(
            "The cameras do not say for which heights they are made: give --heights ZMIN ZMAX or --dem."
        )
    return min(low for low, _ in bounds), max(high for _, high in bounds)


def neighbours(views: Sequence[View], z_range: tuple[float, float], margin_px: float) -> tuple[NDArray[np.int64], ...]:
    """For each image the numbers of the other images that may show the same ground, in ascending order.

    z_range : heights of the ground, m; margin_px : largest pointing error of each image. Boxes around the footprints
    are compared, so that some of the pairs show no common ground. A spatial index finds them, so that the work does not
    grow with the square of the number of images.
    """
    from shapely import STRtree, box  # a tenth of a second

    boxes = np.array([ground_box(view, z_range, margin_px) for view in views])
    # An image without a finite box may show any ground.
    is_finite = np.isfinite(boxes).all(axis=(1, 2))
    numbers, unlimited = np.flatnonzero(is_finite), np.flatnonzero(~is_finite)
    found = [np.arange(len(views)) if is_infinite else unlimited for is_infinite in ~is_finite]
    outlines = box(*boxes[numbers].reshape(-1, 4).T)
    first, second = STRtree(outlines).query(outlines)
    assert (np.diff(first) >= 0).all(), "the index answers in the order of the questions"
    ends = np.searchsorted(first, np.arange(len(numbers) + 1))
    for k, number in enumerate(numbers.tolist()):
        found[number] = np.union1d(found[number], numbers[second[ends[k] : ends[k + 1]]])
    return tuple(each[each != number] for number, each in enumerate(found))


def shared_parts(
    views: Sequence[View],
    z_ranges: Sequence[tuple[float, float]],
    margin_px: float,
    near: Sequence[NDArray[np.int64]],
) -> list[NDArray[np.bool_]]:
    """For each view the grid of its parts (see `sift.parts`), with those set that another view may show too.

    near : numbers of each view's neighbours, see `neighbours`.
    """
    wanted = [np.zeros(part_grid(held_window(view.image)[2:]), bool) for view in views]
    for i, view in enumerate(views):
        others, every = [views[j] for j in near[i].tolist()], parts(view.image)
        while some := dict(islice(every, PARTS_AT_ONCE)):
            for part in _seen_by(others, view, some, z_ranges, margin_px):
                wanted[i][part] = True
    return wanted


def _seen_by(
    other_views: Sequence[View],
    view: View,
    places: Mapping[tuple[int, int], tuple[int, int, int, int]],
    z_ranges: Sequence[tuple[float, float]],
    margin_px: float,
) -> set[tuple[int, int]]:
    """Parts of a view that another view may show. places : pixels of each part, see `sift.parts`."""
    edge = np.linspace(0.0, 1.0, PART_POINTS)
    row, col, row_end, col_end = np.array(list(places.values())).T[:, :, None]
    y, x = np.broadcast_arrays((row + edge * (row_end - row))[:, :, None], (col + edge * (col_end - col))[:, None])
    xy = np.stack([x, y], axis=-1).reshape(-1, 2)
    lines = [Sightlines.of(view.sensor, xy, z_range) for z_range in z_ranges]
    seen: set[tuple[int, int]] = set()
    for other, line in product(other_views, lines):
        if len(seen) == len(places):
            break
        curves = epipolar_curves(line, other.sensor, line.z_range)
        for number, part in enumerate(places):
            if part not in seen:
                at = slice(number * PART_POINTS**2, (number + 1) * PART_POINTS**2)
                if may_fall_inside(curves.part(at), other.image.shape, margin_px):
                    seen.add(part)
    return seen


def may_fall_inside(curves: EpipolarCurves, shape: tuple[int, int], margin_px: float) -> bool:
    """Whether the box around epipolar curves, widened by a margin, touches an image of that shape."""
    ends = np.concatenate([curves.low, curves.high])
    ends = ends[np.isfinite(ends).all(axis=1)]
    if not len(ends):
        return False
    size = np.array([shape[1], shape[0]])
    return bool((ends.max(axis=0) > -margin_px).all() and (ends.min(axis=0) < size + margin_px).all())


def match_pair(
    views: Sequence[View],
    features: Sequence[Features],
    pair: tuple[int, int],
    sightlines: Sequence[Sightlines],
    options: OrientationOptions,
) -> PairMatches:
    """Matches of two images along epipolar curves that agree with one pointing shift.

    sightlines : of the first image's features, one entry for each range of heights. The range with the most matches
    counts.

    Features are matched twice. The first search takes a sample of the features, within `max_pointing_px` of the curves.
    The second search takes all features, within twice `inlier_px` of the curves at the shift and heights found; there
    are fewer second-best matches, so that more matches are accepted. In reduced images `inlier_px` is multiplied by
    `sift_tolerance_factor`.
    """
    a, b = pair
    inlier_px = options.inlier_px * sift_tolerance_factor([views[a], views[b]], options)
    sensor, xy_b, n_a = views[b].sensor, features[b].xy, len(features[a])
    sample = np.arange(0, n_a, max(n_a // FIRST_SEARCH_FEATURES, 1))
    nothing = np.empty(0, np.int64)
    empty = PairMatches(pair, nothing, nothing, np.empty(0), 0, np.zeros(2))
    max_px, pointing, found, likely_lines = options.max_pointing_px, None, None, sightlines[0]
    for line in sightlines:
        curves = epipolar_curves(line.only(sample), sensor, line.z_range)
        if not len(xy_b) or not may_fall_inside(curves, views[b].image.shape, max_px):
            continue
        first, second = match_along_curves(curves, features[a].only(sample), features[b], max_px, MAX_DESCRIPTOR_RATIO)
        here = epipolar_offsets(line.only(sample[first]), sensor, xy_b[second], line.z_range)
        shift = find_shift(here, max_px, inlier_px)
        if pointing is None or shift.inliers.sum() > pointing.inliers.sum():
            pointing, found, likely_lines = shift, here, line
    if pointing is None or found is None or not pointing.is_certain(options.min_ties):
        return empty
    likely, near_px = likely_range(found.z[pointing.inliers]), 2.0 * inlier_px
    curves = epipolar_curves(likely_lines, sensor, likely).moved(pointing.shift_px)
    first, second = match_along_curves(curves, features[a], features[b], near_px, MAX_DESCRIPTOR_RATIO)
    moved_b = xy_b[second] - pointing.shift_px
    rest = find_shift(epipolar_offsets(likely_lines.only(first), sensor, moved_b, likely), near_px, inlier_px)
    if not rest.is_certain(options.min_ties):
        return empty
    keep = rest.inliers
    found = epipolar_offsets(likely_lines.only(first[keep]), sensor, xy_b[second[keep]], likely)
    return PairMatches(pair, first[keep], second[keep], found.z, len(first), pointing.shift_px + rest.shift_px)


def sift_tolerance_factor(views: Sequence[View], options: OrientationOptions) -> float:
    """Factor by which features of reduced images may lie farther from their epipolar curves than those of halved
    ones."""
    return max(1.0, *(reduction(held_window(view.image)[2:], options) / 2.0 for view in views))


def likely_range(z: FloatArray) -> tuple[float, float]:
    """Range of heights (m) for the second search: that of nearly all matches z (n,), widened by itself at both ends.

    It is not limited to the requested heights, because a pointing error along the curves raises or lowers all matches.
    """
    low, high = np.percentile(z, (5.0, 95.0))
    return low - (high - low) - 1.0, high + (high - low) + 1.0


def match_along_curves(
    curves: EpipolarCurves, features_a: Features, features_b: Features, max_px: float, ratio: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Numbers (k,) and (k,) of the features that match each other best, within `max_px` of the epipolar curve.

    A match is accepted where its descriptor distance is below `ratio` times that of the second-best match elsewhere
    near the curve. Features are looked up in the cells of a grid, so that time grows with their number, not its square.
    """
    best_of_a, best_of_b = np.empty(len(features_a), np.int64), np.empty(len(features_b), np.int64)
    segments = CurveSegments(curves.low, curves.high, features_a.descriptors)
    second = SecondFeatures(features_b.xy, features_b.descriptors)
    nearest_descriptors(segments, second, max_px, ratio, best_of_a, best_of_b)
    first = np.flatnonzero(best_of_a >= 0)
    first = first[best_of_b[best_of_a[first]] == first]
    return first, best_of_a[first]


def join_tracks(features: Sequence[Features], pairs: tuple[PairMatches, ...], z_range: tuple[float, float]) -> Ties:
    """Tie points from the matches of all pairs. Matches that share a feature belong to the same ground point.

    A point that one image would show twice is a contradiction and is dropped. Several features at one place, which
    differ in their direction only, count as one.
    """
    start = np.concatenate([[0], np.cumsum([len(f) for f in features])]).astype(np.int64)
    place = np.concatenate([same_place_numbers(f.xy) + start[i] for i, f in enumerate(features)])
    one = np.concatenate([place[start[p.views[0]] + p.first] for p in pairs] or [np.empty(0, np.int64)])
    two = np.concatenate([place[start[p.views[1]] + p.second] for p in pairs] or [np.empty(0, np.int64)])
    heights = np.concatenate([p.z for p in pairs] or [np.empty(0)])
    track = linked(one, two, int(start[-1]))
    node = np.unique(np.concatenate([one, two]))
    view = np.searchsorted(start, node, side="right") - 1
    twice = np.unique(track[node] * len(features) + view, return_counts=True)
    bad = np.unique(twice[0][twice[1] > 1] // len(features))
    good = ~np.isin(track[node], bad)
    node, view = node[good], view[good]
    _, point = np.unique(track[node], return_inverse=True)
    number = np.full(int(track.max(initial=-1)) + 1, -1)
    number[track[node]] = point
    of_match = number[track[one]]
    kept = of_match >= 0
    n_points = int(point.max(initial=-1)) + 1
    z = np.bincount(of_match[kept], heights[kept], n_points) / np.bincount(of_match[kept], minlength=n_points)
    xy = np.concatenate([f.xy for f in features])[node] if len(node) else np.empty((0, 2))
    return Ties(Observations(view, point, xy), z, pairs, z_range)


def linked(one: NDArray[np.int64], two: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """Number (count,) of the first feature that each feature is linked to, directly or through others.

    one, two : (k,) numbers of the features at the ends of the links. Every round gives both ends the smaller number and
    then follows numbers to the first feature, so that a chain of n links takes about log n rounds.
    """
    number = np.arange(count)
    while True:
        least = np.minimum(number[one], number[two])
        if (number[one] == least).all() and (number[two] == least).all():
            return number
        np.minimum.at(number, number[one], least)
        np.minimum.at(number, number[two], least)
        while (number[number] != number).any():
            number = number[number]


def same_place_numbers(xy: FloatArray) -> NDArray[np.int64]:
    """Number (n,) of the first feature at the same place as each feature; xy : (n, 2) px."""
    _, first, inverse = np.unique(np.round(xy, 2), axis=0, return_index=True, return_inverse=True)
    return np.asarray(first[inverse.ravel()])
