from __future__ import annotations

import numpy as np
import pytest

from zlocus.core import unnamed_files
from zlocus.core.errors import OutputError


@pytest.mark.parametrize("dtype", ["float32", "uint16"])
def test_values_on_disk_are_the_same(dtype):
    values = np.arange(12, dtype=dtype).reshape(3, 4)
    kept = unnamed_files.on_disk(values, "Features")
    assert kept.dtype == values.dtype
    np.testing.assert_array_equal(kept, values)
    assert not kept.flags.writeable


def test_a_full_disk_is_reported(monkeypatch):
    def full():
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(unnamed_files.tempfile, "TemporaryFile", full)
    with pytest.raises(OutputError, match=r"^Features of the images cannot.*No space left on device.*TMPDIR"):
        unnamed_files.on_disk(np.zeros((3, 128), np.float32), "Features of the images")
