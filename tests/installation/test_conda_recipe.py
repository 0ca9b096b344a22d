"""The conda recipe: rendered without a network, and with the requirements of pyproject.toml."""

from __future__ import annotations

import tomllib

import pytest
import yaml

from conda_names import conda_requirements
from lowest_versions import EXTRAS
from places import ROOT
from zlocus import __version__

RECIPE = ROOT / "packaging" / "conda" / "recipe.yaml"


@pytest.fixture
def project():
    return tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_the_requirements_are_those_of_the_project(project):
    needed = yaml.safe_load(RECIPE.read_text(encoding="utf-8"))["requirements"]
    of_project = conda_requirements()
    assert needed["run"] == [f"python {project['requires-python']}", *of_project]
    assert needed["run_constraints"] == conda_requirements(EXTRAS)[len(of_project) :]
    assert f"python {project['requires-python']}" in needed["host"]


def test_the_recipe_renders_to_a_package_of_any_platform(project):
    rattler_build = pytest.importorskip(
        "rattler_build", reason="py-rattler-build is not installed: no recipe is rendered"
    )
    (rendered,) = rattler_build.Stage0Recipe.from_file(str(RECIPE)).render()
    recipe = rendered.recipe
    assert (recipe.package.name, str(recipe.package.version)) == ("zlocus", __version__)
    assert recipe.build.noarch == "python"
    assert [str(each) for each in recipe.requirements.run][1:] == conda_requirements()
    about = recipe.about.to_dict()
    assert (about["license"], about["summary"]) == (project["license"], project["description"])


def test_the_command_is_that_of_the_project(project):
    build = yaml.safe_load(RECIPE.read_text(encoding="utf-8"))["build"]
    assert build["python"]["entry_points"] == [f"{name} = {target}" for name, target in project["scripts"].items()]
