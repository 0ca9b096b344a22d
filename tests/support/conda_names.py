"""Requirements of pyproject.toml as conda writes them."""

from __future__ import annotations

from packaging.requirements import Requirement

from lowest_versions import requirements

LOWEST_PYTHON = "3.11"
# Packages that conda-forge has under another name.
CONDA_NAMES = {"lazrs": "lazrs-python", "matplotlib": "matplotlib-base", "opencv-python-headless": "py-opencv"}


def conda_requirement(required: Requirement) -> str:
    """One line of a recipe, such as `numpy >=1.24.0`. OpenCV's version of the wheel has a fourth number of its own."""
    bounds = sorted((bound.operator, bound.version) for bound in required.specifier)
    if required.name == "opencv-python-headless":
        bounds = [(operator, ".".join(version.split(".")[:3])) for operator, version in bounds]
    lower_first = sorted(bounds, key=lambda bound: bound[0] != ">=")
    name = CONDA_NAMES.get(required.name, required.name)
    return f"{name} {','.join(operator + version for operator, version in lower_first)}"


def conda_requirements(extras: tuple[str, ...] = ()) -> list[str]:
    """The requirements of zlocus and of extras for the lowest Python, in the order of pyproject.toml."""
    needed = requirements(extras)
    at_lowest = {"python_version": LOWEST_PYTHON}
    return [conda_requirement(each) for each in needed if each.marker is None or each.marker.evaluate(at_lowest)]
