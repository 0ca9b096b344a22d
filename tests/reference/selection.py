"""Slow twins of the labels, the order and the stop of search images, in plain loops."""

from __future__ import annotations

import math


def peaks(curve, step_px, options):
    """(rho1, rho2, whether the curve is open) of one match curve; None for a missing correlation."""
    visible = [k for k, value in enumerate(curve) if not math.isnan(value)]
    if not visible:
        return None, None, True
    peak = max(visible, key=lambda k: (curve[k], -k))
    rho2 = None
    for k in visible:
        if k - 1 in visible and k + 1 in visible and curve[k] > curve[k - 1] and curve[k] > curve[k + 1]:
            is_second_peak = round(abs(k - peak) * step_px, 6) >= options.second_peak_distance_px
            if is_second_peak and (rho2 is None or curve[k] > rho2):
                rho2 = curve[k]
    is_short = len(visible) / len(curve) < options.min_visible_share
    is_open = peak - 1 not in visible or peak + 1 not in visible or is_short
    return curve[peak], rho2, is_open


def label(curve, step_px, options):
    """Table 1, line by line."""
    rho1, rho2, is_open = peaks(curve, step_px, options)
    if rho1 is None:
        return -1
    if rho2 is None or rho2 == 0 or (rho2 < 0 and options.negative_second_peak == "infinite"):
        ratio = math.inf
    else:
        ratio = abs(rho1 / rho2)
    good = [(options.rho1_high, options.ratio_high), (options.rho1_middle, options.ratio_middle),
            (options.rho1_low, options.ratio_low)]  # fmt: skip
    if any(rho1 > least and ratio > clear for least, clear in good):
        return 0 if is_open else 1
    if rho1 > options.rho1_low or (rho1 > options.rho1_fair and ratio > options.ratio_fair):
        return 0
    return -1


def radius_neighbours(features, at, options):
    """(order_source, feature points by distance) of one cell."""
    by_distance = sorted((math.hypot(at[0] - x, at[1] - y), n) for n, (x, y) in enumerate(features))
    close = [n for distance, n in by_distance if distance <= options.radius_px]
    if close:
        return 0, close
    widest = options.max_radii * options.radius_px
    if not by_distance or by_distance[0][0] > widest:
        return 2, []
    farthest = by_distance[min(options.nearest, len(by_distance)) - 1][0]
    return 1, [n for distance, n in by_distance if distance <= min(farthest, widest)]


def order(labels, neighbours, options):
    """Search images of one cell, best first. labels : a list per feature point."""

    def accumulated(points, image):
        values = [labels[n][image] for n in points]
        return sum(values) if options.accumulate == "sum" else values.count(1)

    n_images = len(labels[0])
    scene = sorted(range(n_images), key=lambda image: (-accumulated(range(len(labels)), image), image))
    return sorted(
        scene,
        key=lambda image: (
            -accumulated(neighbours, image),
            [-labels[n][image] for n in neighbours[:40]],
        ),
    )


def matched(volume, order_of, visible, step_px, options):
    """(curve, images used, whether it stopped) of one cell by the paper's rule. volume : [image][height]."""
    used = []
    curve = [math.nan] * len(volume[0])
    for image in order_of:
        if not visible[image]:
            continue
        used.append(image)
        for k in range(len(curve)):
            values = [volume[i][k] for i in used if not math.isnan(volume[i][k])]
            curve[k] = sum(values) / len(values) if values else math.nan
        if label(curve, max(step_px[i] for i in used), options) == 1:
            return curve, used, True
    return curve, used, False
