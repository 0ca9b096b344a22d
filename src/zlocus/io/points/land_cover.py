"""Kinds of ground of points: names in tables and codes of laser points, and which of them are vegetated."""

from __future__ import annotations

# Codes of LAS 1.4 (ASPRS 2019, table 17), as far as they have a name.
LASER_NAMES = {
    0: "never classified", 1: "unclassified", 2: "ground", 3: "low vegetation", 4: "medium vegetation",
    5: "high vegetation", 6: "building", 7: "low noise", 9: "water", 10: "rail", 11: "road surface", 13: "wire",
    14: "wire", 15: "tower", 16: "wire connector", 17: "bridge deck", 18: "high noise",
    20: "ignored ground", 22: "temporal",
}  # fmt: skip
LASER_VEGETATION = (3, 4, 5)
LASER_NOISE = (7, 18)
# Of a column that says yes or no, these mean vegetated or not.
YES, NO = ("1", "1.0", "true", "yes", "y", "t"), ("0", "0.0", "false", "no", "n", "f", "")
VEGETATED, NOT_VEGETATED = "vegetated", "non-vegetated"
# Names of land cover in tables of check points, in English and German.
VEGETATION = (
    VEGETATED, "vva", "vegetation", "low vegetation", "medium vegetation", "high vegetation", "tree", "trees", "forest",
    "forested", "fully forested", "wood", "woods", "woodland", "brush", "brushland", "shrub", "shrubs", "bush",
    "tall weeds", "weeds and crops", "crops", "tall grass", "high grass", "wald", "baum", "gebüsch", "hohes gras",
)  # fmt: skip
OTHER_COVER = (
    NOT_VEGETATED, "non vegetated", "nonvegetated", "unvegetated", "nva", "", "open", "open terrain", "bare",
    "bare earth", "bare ground", "bare soil", "soil", "sand", "rock", "rocks", "ground", "terrain", "urban", "road",
    "asphalt", "concrete", "paved", "gravel", "roof", "building", "buildings", "grass", "short grass", "lawn", "meadow",
    "low grass", "water", "straße", "strasse", "boden", "wiese", "gebäude", "dach",
)  # fmt: skip


def laser_name(code: int) -> str:
    """The name of a code of laser points: `2 ground`; the number alone where it has none."""
    return f"{code} {LASER_NAMES[code]}" if code in LASER_NAMES else str(code)


def cover_name(value: str, column: str) -> str:
    """The name of a kind of ground in a table, from a value and the name of its column.

    Numbers are codes of laser points, except in a column named `vegetated`, which says yes or no.
    """
    plain = value.strip()
    if column.strip().lower() == VEGETATED and plain.lower() in (*YES, *NO):
        return VEGETATED if plain.lower() in YES else NOT_VEGETATED
    whole = plain.removesuffix(".0")
    return laser_name(int(whole)) if whole.isdecimal() and len(whole) <= 4 else plain
