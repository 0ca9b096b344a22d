"""The `mask` entry of a view in a `scene.yaml`: a file, a mapping with its options, or a list of these."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, field_validator, model_validator

from zlocus.io.schema import FiniteNumber, StrictModel, WholeNumber


class MaskEntry(StrictModel):
    """A mask of an image.

    file : raster or polygons; kind : what a file is whose name does not say it (`MASK_KINDS` of `open_mask`);
    values : which values of a raster, or which classes by their names, are masked, None: the usual ones; band : of a
    raster, by number or name; names : names of the values of a raster that does not name them itself; coordinates : of
    polygons, columns and rows from the centre (`pixels`) or the outer corner (`pixel_corners`) of the first pixel, or
    those of their CRS on the `ground`; height : ellipsoidal height (m) of polygons on the ground, None: the mean height
    of the RPC; outside : whether everything but the given pixels is masked.
    """

    file: str = Field(min_length=1)
    kind: Literal["raster", "polygons", "gml", "udm", "udm2"] | None = None
    values: tuple[WholeNumber | str, ...] | None = Field(default=None, min_length=1)
    band: WholeNumber | str | None = None
    names: dict[str, WholeNumber] | None = Field(default=None, min_length=1)
    coordinates: Literal["pixels", "pixel_corners", "ground"] | None = None
    height: FiniteNumber | None = None
    outside: Literal[True] | None = None

    @field_validator("names", mode="before")
    @classmethod
    def _by_name(cls, names: Any) -> Any:
        """Names as keys, whichever way round they are written: `{cloud: 1}` and `{1: cloud}` are the same."""
        if isinstance(names, dict) and all(isinstance(value, str) for value in names.values()):
            if len(set(names.values())) < len(names):
                raise ValueError("a name is there twice")
            return {name: value for value, name in names.items()}
        return names

    @model_validator(mode="after")
    def _consistent(self) -> MaskEntry:
        if self.height is not None and self.coordinates in ("pixels", "pixel_corners"):
            raise ValueError("height is for polygons on the ground; those in pixels have none")
        return self

    def inside(self, folder: Path) -> MaskEntry:
        """The entry with a path that starts at `folder`."""
        return self.model_copy(update={"file": str(folder / self.file)})


def _as_list(value: Any) -> Any:
    """The entries of all ways to write them: a file, a mapping, or a list of files and mappings."""
    entries = value if isinstance(value, list | tuple) else [value]
    return [{"file": entry} if isinstance(entry, str) else entry for entry in entries]


MaskEntries = Annotated[tuple[MaskEntry, ...], BeforeValidator(_as_list), Field(min_length=1)]
