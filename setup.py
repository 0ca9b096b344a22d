"""The pages of docs/ go into the wheel, where `zlocus docs` finds them. Everything else is in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

HERE = Path(__file__).parent
DOCS = HERE / "docs"


class BuildWithPages(build_py):
    """Copy the pages beside the modules; an editable installation reads them where they are."""

    def run(self) -> None:
        """Build, then copy."""
        super().run()
        if not self.editable_mode:
            # Without notebooks and pictures, which a terminal does not show.
            for page in DOCS.rglob("*.md"):
                target = Path(self.build_lib) / "zlocus" / "pages" / page.relative_to(DOCS)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(page, target)


setup(cmdclass={"build_py": BuildWithPages})
