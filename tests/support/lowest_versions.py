"""The lower bounds of pyproject.toml for one version of Python, as constraints of pip.

`python tests/support/lowest_versions.py 3.11` prints a line `numpy==1.24.0` for each package that zlocus needs.
"""

from __future__ import annotations

import sys
import tomllib

from packaging.requirements import Requirement

from places import ROOT

EXTRAS = ("cluster", "inspect", "parquet", "xarray")


def requirements(extras: tuple[str, ...] = EXTRAS) -> list[Requirement]:
    """What zlocus and its extras need, in the order of pyproject.toml."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extra = project["optional-dependencies"]
    return [Requirement(each) for each in (*project["dependencies"], *(e for name in extras for e in extra[name]))]


def lowest_versions(python: str, extras: tuple[str, ...] = EXTRAS) -> dict[str, str]:
    """The lowest version of each package for a Python such as "3.11"; each package has one."""
    lowest: dict[str, str] = {}
    for required in requirements(extras):
        if required.marker is None or required.marker.evaluate({"python_version": python}):
            bounds = [bound.version for bound in required.specifier if bound.operator == ">="]
            if len(bounds) != 1 or required.name in lowest:
                raise ValueError(f"{required.name} has no lower bound, or several, for Python {python}.")
            lowest[required.name] = bounds[0]
    return lowest


if __name__ == "__main__":
    print(*(f"{name}=={version}" for name, version in lowest_versions(sys.argv[1]).items()), sep="\n")
