"""The changelog lists every configuration key that was renamed."""

from __future__ import annotations

import re

from places import ROOT
from zlocus.core.options.renamed_keys import RENAMED_KEYS


def test_renamed_configuration_keys_are_listed():
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    (section,) = re.findall(r"^### Renamed configuration keys\n(.*?)^### ", changelog, re.MULTILINE | re.DOTALL)
    assert dict(re.findall(r"^\| `(.+?)` \| `(.+?)` \|$", section, re.MULTILINE)) == RENAMED_KEYS
