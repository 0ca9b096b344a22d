"""The masks in the deliveries of vendors, as entries of a view: which kind a file is, and whether it is applied."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from zlocus.core.errors import ConfigError
from zlocus.core.quoting import quoted
from zlocus.io.masks.gml_masks import KIND_OF_LETTERS, kind_of_file
from zlocus.io.masks.mask_entry import MaskEntry

# Masks of polygons whose pixels show no ground. Of a region everything outside of it is masked. Snow, shadows and
# straylight stay: the ground, or what covers it for long, is seen there.
APPLIED = ("cloud", "detector", "hidden", "quality", "region")
RASTER_KINDS = ("classes", "udm", "udm2")
VENDOR_KINDS = (*sorted(set(KIND_OF_LETTERS.values())), *RASTER_KINDS)


def vendor_kind(path: Path) -> str | None:
    """The kind of mask that a file of a delivery is by its name, one of `VENDOR_KINDS`; None where it is no mask.

    `CLD_..._MSK.GML` and the like of Pléiades, Pléiades Neo and SPOT; `*_udm2*.tif` and `*_udm*.tif` of Planet.
    `classes`, a raster whose classes have names, is never told from the name.
    """
    if path.suffix.lower() in (".tif", ".tiff"):
        planet = re.search(r"_(udm2?)(?:_\w+)?\.", path.name.lower())
        return planet[1] if planet else None
    return kind_of_file(path)


def vendor_mask(path: Path, kind: str | None = None, values: Sequence[int | str] | None = None) -> MaskEntry | None:
    """The entry of a vendor's mask for its view; None where such masks are not applied: their pixels show the ground.

    kind : one of `VENDOR_KINDS`, None: by the name of the file; values : classes that are masked, None: those that show
    no ground. With `values` every kind is applied.

    Raises
    ------
    ConfigError
        The kind is not known.
    """
    kind = vendor_kind(path) if kind is None else kind
    if kind not in VENDOR_KINDS:
        raise ConfigError(
            f"{path} is no mask of a kind that is known ({quoted(str(kind))}). Choose from {', '.join(VENDOR_KINDS)}."
        )
    wanted = None if values is None else tuple(values)
    if kind in RASTER_KINDS:
        return MaskEntry.model_validate(
            {"file": str(path), "kind": "raster" if kind == "classes" else kind, "values": wanted}
        )
    if wanted is None and kind not in APPLIED:
        return None
    return MaskEntry.model_validate({"file": str(path), "kind": "gml", "values": wanted})
