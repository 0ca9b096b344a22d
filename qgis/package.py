"""Packs the plugin for `Plugins > Manage and Install Plugins > Install from ZIP` of QGIS: python qgis/package.py."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

PLUGIN = Path(__file__).resolve().parent / "zlocus_processing"
LICENCE = PLUGIN.parent.parent / "LICENSE"
# A time that does not depend on the machine, so that the same files make the same archive.
TIME = (2020, 1, 1, 0, 0, 0)


def plugin_files() -> dict[str, Path]:
    """The files of the archive by their names in it: those of the plugin, and the licence, in one folder."""
    inner = [path for path in sorted(PLUGIN.rglob("*")) if path.is_file() and "__pycache__" not in path.parts]
    names = {f"{PLUGIN.name}/{path.relative_to(PLUGIN).as_posix()}": path for path in inner}
    return names | {f"{PLUGIN.name}/LICENSE": LICENCE}


def write_archive(archive: Path) -> None:
    """Write the archive."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for name, path in plugin_files().items():
            entry = zipfile.ZipInfo(name, TIME)
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            file.writestr(entry, path.read_bytes())


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("build") / f"{PLUGIN.name}.zip"
    write_archive(target)
    print(f"{target} written: choose it with Plugins > Manage and Install Plugins > Install from ZIP.")
