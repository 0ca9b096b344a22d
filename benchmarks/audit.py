"""Known vulnerabilities of everything installed beside zlocus, as the package registry lists them: `make audit`, or

    python benchmarks/audit.py [--registry URL]

The registry answers for a version; where it does not, for the latest one, which tells nothing of an older one that is
installed. Such versions are listed too: whoever needs to know asks for them elsewhere. Status 1 where something is
known.
"""

from __future__ import annotations

import argparse
import json
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.metadata import distributions
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

REGISTRY = "https://pypi.org/pypi"
OWN = "zlocus"
AT_ONCE, TIMEOUT_S = 8, 60.0


@dataclass(frozen=True)
class Answer:
    """What the registry says of an installed version. known : vulnerabilities; None where it says nothing of it."""

    name: str
    version: str
    known: tuple[str, ...] | None


def asked(name: str, version: str, registry: str = REGISTRY) -> Answer:
    """The registry's answer for a version, or for the latest one if that is it."""
    for page in (f"{name}/{version}", name):
        try:
            with urlopen(Request(f"{registry}/{page}/json"), timeout=TIMEOUT_S) as reply:
                found = json.load(reply)
        except HTTPError as error:
            if error.code != 404:
                raise
            continue
        if found["info"]["version"] == version:
            return Answer(name, version, tuple(sentence(v) for v in found["vulnerabilities"] if not v.get("withdrawn")))
    return Answer(name, version, None)


def sentence(vulnerability: dict[str, Any]) -> str:
    """What is known, and where it is mended."""
    mended = ", ".join(vulnerability.get("fixed_in") or ()) or "no version"
    return f"{vulnerability['id']}: {vulnerability.get('summary') or 'no summary'} (mended in {mended})"


def main() -> int:
    """Ask for all, and say what is known."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--registry", default=REGISTRY, metavar="URL", help="where NAME/VERSION/json is answered")
    registry = parser.parse_args().registry.rstrip("/")
    installed = sorted({(d.metadata["Name"], d.version) for d in distributions() if d.metadata["Name"] != OWN})
    with ThreadPoolExecutor(AT_ONCE) as pool:
        answers = list(pool.map(lambda one: asked(*one, registry), installed))
    bad = [answer for answer in answers if answer.known]
    unknown = [answer for answer in answers if answer.known is None]
    for answer in bad:
        print(f"{answer.name} {answer.version}", *answer.known or (), sep="\n    ")
    if unknown:
        print("The registry says nothing of:", ", ".join(f"{a.name} {a.version}" for a in unknown))
    print(f"{len(answers) - len(unknown)} of {len(answers)} versions looked up, {len(bad)} with known vulnerabilities.")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
