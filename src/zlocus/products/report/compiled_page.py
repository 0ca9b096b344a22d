"""The compiled template of the report, kept beside it as Python keeps its own compiled modules."""

from __future__ import annotations

import pickle
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from jinja2 import BytecodeCache
from jinja2.bccache import Bucket

from zlocus.core.errors import OutputError
from zlocus.io.atomic_write import write_atomically


class CompiledPages(BytecodeCache):
    """Compiled templates in a folder: a tenth of a second less for each report.

    A file of another version of Jinja, Python or the template is not used, nor is a damaged one. Where none can be
    written, none is kept.
    """

    def __init__(self, folder: Path) -> None:
        """Compiled templates in a folder."""
        self.folder = folder

    def load_bytecode(self, bucket: Bucket) -> None:
        """Read the compiled template of a bucket, where it is kept."""
        with suppress(OSError, EOFError, ValueError, pickle.UnpicklingError), open(self._path(bucket), "rb") as file:
            bucket.load_bytecode(file)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep the compiled template of a bucket."""
        with suppress(OutputError, OSError):
            self.folder.mkdir(exist_ok=True)
            write_atomically(self._path(bucket), lambda part: part.write_bytes(bucket.bytecode_to_string()))

    def _path(self, bucket: Bucket) -> Path:
        return self.folder / f"page-{version('jinja2')}-{bucket.key}.jinja"
