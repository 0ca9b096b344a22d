"""StereoSGBM on rectified pairs, in an environment with OpenCV and NumPy only: `python match_opencv.py JOB`."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import cv2
import numpy as np


def stretched(grey: np.ndarray, percent: list[float]) -> np.ndarray:
    """Grey values stretched to 8 bits between two percentiles; images of 8 bits are not changed."""
    if grey.dtype == np.uint8:
        return grey
    dark, bright = np.percentile(grey, percent)
    return np.clip(255.0 * (grey.astype(float) - dark) / (bright - dark), 0, 255).astype(np.uint8)


def match(pair: dict, options: dict) -> None:
    """Write the disparity (r, c) px: column in the first image less column in the second, NaN without a match."""
    images = (cv2.imread(pair[side], cv2.IMREAD_UNCHANGED) for side in ("left", "right"))
    first, count = pair["first"], pair["count"]
    # Without margins it would leave out the columns that the largest disparities cannot reach.
    left, right = (
        cv2.copyMakeBorder(stretched(image, options["grey_percent"]), 0, 0, count, count, cv2.BORDER_REPLICATE)
        for image in images
    )
    taken = {name: value for name, value in options.items() if name not in ("comment", "dense", "grey_percent")}
    matcher = cv2.StereoSGBM_create(minDisparity=first, numDisparities=count, **taken)
    found = matcher.compute(left, right)[:, count:-count].astype(np.float32) / 16.0
    np.save(pair["disparity"], np.where(found >= first, found, np.nan))


def main() -> None:
    job = json.loads(Path(sys.argv[1]).read_text())
    cv2.setNumThreads(job["threads"])
    for pair in job["pairs"]:
        match(pair, job["options"])


if __name__ == "__main__":
    main()
