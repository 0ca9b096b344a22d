"""Results files: what they hold, and how they tell that the code has changed since."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

import recording
import result_files
from benchmark_scripts import run_script
from places import ROOT
from result_files import PACKAGE, RENDERER, read_results, record_results
from workplace import CannotRun, Figure

KEYS = {"row", "commit", "date", "machine", "command", "seconds", "code", "figures"}
FIGURE_KEYS = {"what", "value", "unit", "at_least", "at_most", "fails_when"}
FILES = sorted(result_files.RESULTS.glob("*.json"))


def git(folder: Path, *words: str) -> str:
    named = ["-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false"]
    return subprocess.run(["git", *named, *words], cwd=folder, check=True, capture_output=True, text=True).stdout


@pytest.fixture
def checkout(tmp_path, monkeypatch) -> Path:
    """A small git repository in place of this one, with a package and its renderer."""
    for name in (f"{PACKAGE}/a.py", f"{RENDERER}/b.py", "docs/c.md"):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("1\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-q", "-m", "first")
    monkeypatch.setattr(result_files, "ROOT", tmp_path)
    return tmp_path


def test_a_measured_row_is_read_back_as_it_was_written(tmp_path):
    figures = (Figure("share", 0.98765432198, at_least=0.9, fails_when="a fault"), Figure("none", math.nan, "m"))
    told, inputs = "make measure ROW=row", {"seeds": [3]}
    written = record_results("row", figures, told, seconds=1.26, inputs=inputs, folder=tmp_path)
    found = read_results("row", tmp_path)
    assert found.figure("share") == Figure("share", 0.9876543, at_least=0.9, fails_when="a fault")
    assert math.isnan(found.value("none"))
    assert (found.seconds, found.inputs, found.command) == (1.3, inputs, told)
    assert found.code == written.code == {PACKAGE: result_files.digest_of(PACKAGE)}
    assert [path.name for path in tmp_path.iterdir()] == ["row.json"]
    with pytest.raises(CannotRun, match="has no figure `other`"):
        found.figure("other")
    with pytest.raises(CannotRun, match="is missing: measure the row with `make measure town`"):
        read_results("town", tmp_path)


def test_two_figures_with_one_label_are_refused(tmp_path):
    with pytest.raises(CannotRun, match="two figures named `a`"):
        record_results("row", [Figure("a", 1.0), Figure("a", 2.0)], "", folder=tmp_path)
    assert not list(tmp_path.iterdir())


def test_a_digest_changes_with_the_files_of_its_part_only(checkout):
    package, renderer = (result_files.digest_of(part) for part in (PACKAGE, RENDERER))
    (checkout / RENDERER / "b.py").write_text("2\n")
    assert result_files.digest_of(PACKAGE) == package
    assert result_files.digest_of(RENDERER) != renderer
    (checkout / PACKAGE / "a.py").write_text("2\n")
    assert result_files.digest_of(PACKAGE) != package
    assert result_files.digest_at(PACKAGE, "HEAD") == package
    assert result_files.digest_at(RENDERER, "HEAD") == renderer


def test_results_older_than_their_code_name_the_part(checkout, monkeypatch):
    monkeypatch.setattr(result_files, "this_machine", dict)
    code = result_files.code_of((PACKAGE, RENDERER))
    results = record_results("row", [], "", code=code, folder=checkout / "results")
    assert result_files.stale_parts(results) == []
    assert not results.commit.endswith("-dirty")
    (checkout / RENDERER / "new.py").write_text("")
    assert result_files.stale_parts(results) == [RENDERER]


def test_code_that_changes_during_a_measurement_is_marked(checkout, monkeypatch):
    """The digests are those of the beginning, even where the change is committed before the end."""
    monkeypatch.setattr(result_files, "this_machine", dict)
    code = result_files.code_of((PACKAGE,))
    (checkout / PACKAGE / "a.py").write_text("2\n")
    git(checkout, "commit", "-q", "-a", "-m", "second")
    results = record_results("row", [], "", code=code, folder=checkout / "results")
    assert results.commit.endswith("-dirty")
    assert results.code == code
    assert result_files.stale_parts(results) == [PACKAGE]


def test_a_commit_is_marked_where_measured_files_differ_from_it(checkout):
    commit = git(checkout, "rev-parse", "--short=12", "HEAD").strip()
    (checkout / RENDERER / "b.py").write_text("2\n")
    (checkout / "docs" / "c.md").write_text("2\n")
    assert result_files.commit_of([PACKAGE]) == commit
    assert result_files.commit_of([PACKAGE, RENDERER]) == f"{commit}-dirty"


def test_the_tables_that_a_script_prints_are_kept(tmp_path, monkeypatch, capsys):
    script = tmp_path / "benchmarks" / "tell.py"
    script.parent.mkdir()
    script.write_text("print('first\\n| a | b |\\n|---|---|\\n| 1 | x \\\\| y |\\n\\n| c |\\n|---|\\n| 2 |')")
    kept = {}
    monkeypatch.setattr(recording, "ROOT", tmp_path)
    monkeypatch.setattr(result_files, "ROOT", tmp_path)
    monkeypatch.setattr(recording, "record_results", lambda *words, **more: kept.update(more, words=words))
    run_script(monkeypatch, recording, "told", "tell.py", "--size", 3)
    assert kept["tables"] == [[["a", "b"], ["1", "x | y"]], [["c"], ["2"]]]
    assert kept["words"] == ("told", (), "python benchmarks/recording.py told tell.py --size 3")
    assert "benchmarks/tell.py" in kept["code"]
    assert capsys.readouterr().out.startswith("first\n")
    script.write_text("import sys; print('| a |\\n|---|'); sys.exit(2)")
    with pytest.raises(CannotRun, match="ends with status 2"):
        run_script(monkeypatch, recording, "told", "tell.py")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_a_results_file_holds_all_that_is_needed_to_measure_again(path):
    record = json.loads(path.read_text(encoding="utf-8"))
    assert record.keys() >= KEYS
    assert record["row"] == path.stem
    assert record["command"]
    assert record["machine"]["processor"]
    assert record["figures"] or record["tables"]
    for figure in record["figures"]:
        assert figure.keys() >= FIGURE_KEYS
        has_bar = figure["at_least"] is not None or figure["at_most"] is not None
        assert figure["fails_when"] or not has_bar, f"{path.name}: how could `{figure['what']}` miss its bar?"
    assert "recording.py" not in record["command"] or record["tables"]


def test_the_commits_of_the_results_exist():
    done = subprocess.run(["git", "rev-parse", "--is-shallow-repository"], cwd=ROOT, capture_output=True, text=True)
    if done.stdout.strip() != "false":
        pytest.skip("the git history is missing or cut off: no commit can be looked up")
    for path in FILES:
        commit = json.loads(path.read_text(encoding="utf-8"))["commit"]
        if commit != result_files.NOT_RECORDED:
            name = commit.removesuffix(result_files.DIRTY)
            assert subprocess.run(["git", "cat-file", "-e", f"{name}^{{commit}}"], cwd=ROOT).returncode == 0, path.name


def test_this_machine_is_described():
    found = result_files.this_machine()
    assert found["python"] == sys.version.split()[0]
    assert found["cores"]
