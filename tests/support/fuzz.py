"""Coverage-guided fuzzing of the readers of every format.

    python -m pip install atheris
    python tests/support/fuzz.py --seconds 3600             # of all formats together
    python tests/support/fuzz.py scene-frame --seconds 600  # of one

Formats are those of `damage_cases.CASES`. A reader must do what `test_io_damaged_files` requires: return a result or
raise a `ZlocusError` of one sentence, within limits of time and memory. Inputs that reach new code are stored in
`tests/fuzz_seeds/FORMAT`, the smallest first; so are inputs that fail, under the name `fail-...`.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import warnings
from itertools import accumulate
from pathlib import Path

from places import TESTS

SEEDS = TESTS / "fuzz_seeds"
TIMEOUT_S, MAX_MB = 20, 3000
# Of a format, of a seed, and of all seeds of a format.
MAX_SEEDS, MAX_SEED_BYTES, MAX_SEED_TOTAL_BYTES = 40, 20_000, 24_000
MAX_TOKENS = 200
FAILED = "fail-"


def fuzz_one(name: str, corpus: Path, artifacts: Path, seconds: int) -> None:
    """Fuzz a format in this process, which ends with it."""
    import atheris

    with atheris.instrument_imports(include=["zlocus"]):
        from damage import TOKEN, WORDS
        from damage_cases import CASES
        from damage_outcomes import check_sentence
        from zlocus.core.errors import ZlocusError

    case = CASES[name]
    path = case.write(Path(tempfile.mkdtemp(dir=corpus.parent)))
    (corpus / "whole").write_bytes(path.read_bytes())

    def read(content: bytes) -> None:
        path.write_bytes(content)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.filterwarnings("ignore", "Use `@` matmul", PendingDeprecationWarning)
                case.read(path)
        except ZlocusError as error:
            check_sentence(str(error), path)

    # What the file is made of, and what could stand in its place.
    tokens = {m.group() for m in TOKEN.finditer(path.read_bytes())} if case.text else set()
    listed = sorted(tokens)[:MAX_TOKENS] + [word.encode() for word in WORDS if 0 < len(word) < 40]
    dictionary = corpus.parent / "words.dict"
    dictionary.write_text("".join('"' + "".join(f"\\x{byte:02x}" for byte in word) + '"\n' for word in listed))
    limits = {"max_total_time": seconds, "timeout": TIMEOUT_S, "rss_limit_mb": MAX_MB}
    limits["max_len"] = max(MAX_SEED_BYTES, 2 * path.stat().st_size)
    options = {"dict": dictionary, "artifact_prefix": f"{artifacts}/", **limits}
    words = [sys.argv[0], str(corpus), *(f"-{name}={value}" for name, value in options.items())]
    atheris.Setup(words, read)
    atheris.Fuzz()


def fuzz(name: str, seconds: float) -> int:
    """Fuzz a format in processes of their own, another one after each failure, and keep what was found; how many
    failed."""
    import time

    kept = SEEDS / name
    kept.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        corpus, artifacts = Path(scratch) / "corpus", Path(scratch) / "artifacts"
        for folder in (corpus, artifacts):
            folder.mkdir()
        for seed in kept.iterdir():
            (corpus / seed.name).write_bytes(seed.read_bytes())
        end, n_failed = time.monotonic() + seconds, 0
        while (left := int(end - time.monotonic())) > 0:
            words = [sys.executable, __file__, "--one", name, str(corpus), str(artifacts), str(left)]
            done = subprocess.run(words, capture_output=True, text=True, errors="replace", check=False)
            print(name, next((line for line in reversed(done.stderr.splitlines()) if "cov:" in line), "?"), flush=True)
            if done.returncode == 0:
                break
            print("\n".join(done.stderr.splitlines()[-40:]), flush=True)
            n_failed += 1
        chosen = sorted(
            (p for p in corpus.iterdir() if p.stat().st_size <= MAX_SEED_BYTES), key=lambda p: p.stat().st_size
        )
        sizes = accumulate(seed.stat().st_size for seed in chosen[:MAX_SEEDS])
        for seed in (seed for seed, size in zip(chosen, sizes, strict=False) if size <= MAX_SEED_TOTAL_BYTES):
            (kept / seed.name).write_bytes(seed.read_bytes())
        for artifact in artifacts.iterdir():
            (kept / f"{FAILED}{artifact.name[:40]}").write_bytes(artifact.read_bytes())
    return n_failed


def main() -> int:
    """Fuzz what is asked for."""
    if sys.argv[1:2] == ["--one"]:
        name, corpus, artifacts, seconds = sys.argv[2:]
        fuzz_one(name, Path(corpus), Path(artifacts), int(seconds))
        return 0
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("formats", nargs="*", metavar="FORMAT")
    parser.add_argument("--seconds", type=float, default=3600.0, help="of all formats together")
    asked = parser.parse_args()
    from damage_cases import CASES

    chosen = asked.formats or list(CASES)
    failed = {name: n for name in chosen if (n := fuzz(name, asked.seconds / len(chosen)))}
    print(f"{len(chosen)} formats, failed: {failed or 'none'}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
