"""Pandora with libSGM on rectified pairs, through its command, in its environment: `python match_pandora.py JOB`."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import rasterio
from pandora.constants import Criteria


def match(pair: dict, options: dict) -> None:
    """Write the disparity (r, c) px: column in the first image less column in the second, NaN without a match."""
    out = Path(pair["disparity"]).with_suffix("")
    out.mkdir(parents=True, exist_ok=True)
    # Pandora counts disparities with the opposite sign.
    reach = [-(pair["first"] + pair["count"] - 1), -pair["first"]]
    images = {
        "left": {"img": pair["left"], "disp": reach, "nodata": -9999},
        "right": {"img": pair["right"], "nodata": -9999},
    }
    config = out / "config.json"
    config.write_text(json.dumps({"input": images, "pipeline": options["pipeline"]}))
    subprocess.run([Path(sys.executable).with_name("pandora"), config, out], check=True)
    with rasterio.open(out / "left_disparity.tif") as file:
        found = file.read(1).astype(np.float32)
    with rasterio.open(out / "left_validity_mask.tif") as file:
        invalid = (file.read(1) & int(Criteria.PANDORA_MSK_PIXEL_INVALID)) != 0
    np.save(pair["disparity"], np.where(invalid, np.nan, -found))


def main() -> None:
    job = json.loads(Path(sys.argv[1]).read_text())
    for pair in job["pairs"]:
        match(pair, job["options"])


if __name__ == "__main__":
    main()
