"""What a command does without."""

import subprocess
import sys

COMMAND = """
import gc, sys
from zlocus import startup
startup.prepare()
import zlocus.pipeline, pyogrio.raw
print(gc.isenabled(), gc.get_threshold()[0] >= startup.LOOKS[0], hasattr(sys.modules["pandas"], "DataFrame"))
print(*sorted({"matplotlib", "scipy.ndimage", "zlocus.reporting", "zlocus.evaluation.evaluate"} & set(sys.modules)))
"""


def test_what_a_surface_takes_no_part_in_is_not_imported():
    """pyogrio does without pandas; cycles are still looked for."""
    said = subprocess.run([sys.executable, "-c", COMMAND], check=True, capture_output=True, text=True).stdout
    assert said.splitlines() == ["True True False", ""]


def test_the_package_as_a_library_leaves_the_process_alone():
    code = "import gc, sys; was = gc.get_threshold(); import zlocus.api; print(gc.get_threshold() == was, *sys.modules)"
    said = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert said.split()[0] == "True"
    assert "pandas" not in said.split()
