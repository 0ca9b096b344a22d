"""Known vulnerabilities of everything installed beside zlocus, as the package registry lists them: `make audit`, or

    python benchmarks/audit.py [--registry URL]

If the registry does not know a version, its answer for the latest version says nothing about the installed one. Such
packages are listed as unknown. The exit status is 1 if a vulnerability is known.
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
    """Answer of the registry about an installed version. known : vulnerabilities, None for an unknown version."""

    name: str
    version: str
    known: tuple[str, ...] | None


def asked(name: str, version: str, registry: str = REGISTRY) -> Answer:
    """Ask the registry about a version, and about the latest version if it does not know the first."""
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
    """A vulnerability and the versions without it, in one line."""
    mended = ", ".join(vulnerability.get("fixed_in") or ()) or "no version"
    return f"{vulnerability['id']}: {vulnerability.get('summary') or 'no summary'} (mended in {mended})"


def main() -> int:
    """Ask about all installed packages and print the known vulnerabilities; return the exit status."""
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
