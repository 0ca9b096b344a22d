"""What the doctor says to somebody who chooses or buys images. `zlocus rank`, which compares them, knows more."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from zlocus.core.footprints import PairGeometry
from zlocus.core.options import SelectionOptions
from zlocus.orientation.orientation import Orientation
from zlocus.pipeline.rank_advice import missing_image


def image_advice(
    names: Sequence[str],
    orientation: Orientation,
    pairs: Sequence[PairGeometry],
    options: SelectionOptions,
    refused: Sequence[str] = (),
) -> list[str]:
    """Sentences that say which images to keep, which to drop and which to buy.

    names : of the views, to which `pairs` refers by number; refused : names of the images that cannot be used as they
    are, which come before any that could be bought.
    """
    excluded = {each.name for each in orientation.excluded_images}
    kept = [i for i, name in enumerate(names) if name not in excluded]
    sentences = [f"Keep {', '.join(names[i] for i in kept)}."] if kept else []
    if excluded:
        dropped = ", ".join(name for name in names if name in excluded)
        sentences.append(f"Drop {dropped}: a run leaves out what has no part in its tie points, as said above.")
    if refused:
        return [*sentences, f"Mend {', '.join(refused)} before you look for other images: see above what is wrong."]
    ratios = np.array([pair.base_to_height for pair in pairs if set(pair.views) <= set(kept)])
    angles_deg = np.degrees(np.arctan(ratios[np.isfinite(ratios)]))
    if len(kept) < 2 or len(angles_deg):
        sentences.append(missing_image(len(kept), angles_deg, options))
    return sentences
