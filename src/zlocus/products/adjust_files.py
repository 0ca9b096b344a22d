"""Write `.adjust` files of Ames Stereo Pipeline: translation, rotation as a quaternion, pixel offset and scale."""

from __future__ import annotations

from pathlib import Path

from zlocus.sensors.rigid_adjustment import RigidAdjustment

# With `--bundle-adjust-prefix OUT/run` the program looks for OUT/run-IMAGE.adjust.
PREFIX = "run"


def adjust_file_name(image: Path) -> str:
    """The name under which the program looks for the adjustment of an image."""
    return f"{PREFIX}-{image.stem}.adjust"


def write_adjust(path: Path, rigid_adjustment: RigidAdjustment) -> None:
    """Write the adjustment of an image: translation (m, geocentric), quaternion (w, x, y, z), no pixel offset, scale
    1."""
    given = rigid_adjustment.translation.tolist(), rigid_adjustment.quaternion.tolist()
    rows: list[list[float]] = [*given, [0.0, 0.0], [1.0]]
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows) + "\n"
    path.write_text(text, encoding="ascii")
