"""The documentation site: `make docs` builds it into build/docs, without network."""

from __future__ import annotations

import inspect
import sys
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

from pygments.lexers.special import TextLexer  # noqa: E402

from reference_pages import (  # noqa: E402
    command_reference,
    option_reference,
    with_listed_parameters,
)
from zlocus import __version__  # noqa: E402

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "zlocus"
author = "The zlocus developers"
copyright = author
version = release = __version__

extensions = ["sphinx.ext.autodoc", "sphinx.ext.napoleon", "myst_nb"]
# Quotation marks stand in code and in names of files.
smartquotes = False
myst_heading_anchors = 4
# Definition lists, for the glossary. Equations would need a script from elsewhere: pages say them in words and plain
# formulae.
myst_enable_extensions = ["deflist"]

# Notebooks are kept without outputs; `make docs` runs them.
nb_execution_mode = "force"
nb_execution_timeout = 600
nb_execution_raise_on_error = True
nb_merge_streams = True
nb_ipywidgets_js: dict[str, dict[str, str]] = {}

autodoc_typehints = "signature"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 100
# Docstrings set names of the code between single marks.
default_role = "code"
autodoc_member_order = "bysource"

html_theme = "furo"
html_title = f"zlocus {version}"
html_copy_source = False
html_show_sourcelink = False
html_static_path: list[str] = []

# Each of these lines in a page is replaced by what its function makes from the code.
GENERATED = {
    "<!-- generated: commands -->": command_reference,
    "<!-- generated: options -->": option_reference,
}


def fill_in(app: Sphinx, page: str, source: list[str]) -> None:
    """Replace the marked lines of a page, as Sphinx reads it, by the generated parts."""
    for marker, make in GENERATED.items():
        if marker in source[0]:
            source[0] = source[0].replace(marker, make())


def list_parameters(app: Sphinx, what: str, name: str, member: Any, options: Any, lines: list[str]) -> None:
    """Rewrite a docstring so that the parameters of its function or class stand in a list."""
    if what in ("function", "method"):
        lines[:] = with_listed_parameters(lines, inspect.signature(member).parameters)
    elif what == "class" and is_dataclass(member):
        lines[:] = with_listed_parameters(lines, [field.name for field in fields(member)])


def setup(app: Sphinx) -> None:
    """Connect the functions above; Sphinx calls this."""
    app.connect("source-read", fill_in)
    app.connect("autodoc-process-docstring", list_parameters)
    # Tables in text: Pygments has no lexer for them.
    app.add_lexer("csv", TextLexer)
