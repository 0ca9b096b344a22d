"""What the style guide asks of every module, checked on the source."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from places import ROOT

SOURCE = ROOT / "src" / "zlocus"
MODULES = sorted(SOURCE.rglob("*.py"))
MAX_MODULE_LINES = 500
MAX_FUNCTION_LINES = 60
NETWORK = {
    "socket", "urllib", "http", "requests", "ftplib", "smtplib", "aiohttp", "httpx", "starlette", "uvicorn",
}  # fmt: skip
NO_FILES = ("kernels", "sensors", "matching", "surface")
# It finds the folder of compiled kernels, which depends on the content of their sources.
DECORATOR = "kernels/_jit.py"
FILE_CALLS = {
    "open",
    "read_text",
    "read_bytes",
    "write_text",
    "write_bytes",
    "memmap",
    "load",
    "save",
    "fromfile",
    "tofile",
}


def name_of(module: Path) -> str:
    return str(module.relative_to(SOURCE))


every_module = pytest.mark.parametrize("module", MODULES, ids=name_of)


def tree_of(module: Path) -> ast.Module:
    return ast.parse(module.read_text(encoding="utf-8"))


def functions(module: Path) -> list[ast.FunctionDef | ast.AsyncFunctionDef]:
    return [n for n in ast.walk(tree_of(module)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]


def public(body: list[ast.stmt], prefix: str = ""):
    """Public classes, functions and methods with their names."""
    for node in body:
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_"):
            yield prefix + node.name, node
            if isinstance(node, ast.ClassDef):
                yield from public(node.body, f"{prefix}{node.name}.")


def called(module: Path) -> set[str]:
    """Names of everything a module calls: `f` of f() and of x.f()."""
    calls = (n.func for n in ast.walk(tree_of(module)) if isinstance(n, ast.Call))
    return {f.attr if isinstance(f, ast.Attribute) else f.id for f in calls if isinstance(f, ast.Attribute | ast.Name)}


def imported(module: Path) -> set[str]:
    """Top-level names of everything a module imports."""
    found = set()
    for node in ast.walk(tree_of(module)):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module.split(".")[0])
    return found


def test_the_source_is_there():
    assert len(MODULES) > 20


@every_module
def test_modules_stay_short(module):
    assert len(module.read_text(encoding="utf-8").splitlines()) < MAX_MODULE_LINES


@every_module
def test_functions_stay_short(module):
    long = {f.name: f.end_lineno - f.lineno + 1 for f in functions(module)}
    assert {name: lines for name, lines in long.items() if lines > MAX_FUNCTION_LINES} == {}


@every_module
def test_public_names_have_a_docstring(module):
    tree = tree_of(module)
    missing = [name for name, node in public(tree.body) if not ast.get_docstring(node)]
    assert missing == []
    assert ast.get_docstring(tree) or not tree.body


# Modules that answer on this machine, and what they need for it.
LISTENS = {
    "inspector/serving.py": {"socket", "uvicorn"},
    "inspector/server.py": {"starlette"},
    "inspector/guard.py": {"starlette"},
}


@every_module
def test_nothing_reaches_for_the_network(module):
    listens = LISTENS.get(module.relative_to(SOURCE).as_posix(), set())
    assert imported(module) & NETWORK == listens
    addresses = re.findall(r"https?://[^\s\"'>)]+", module.read_text(encoding="utf-8"))
    # The page's own address is made of names that are not known here.
    assert [each for each in addresses if not (listens and re.match(r"http://\{\w+", each))] == []


INNER = [m for m in MODULES if m.relative_to(SOURCE).parts[0] in NO_FILES and name_of(m) != DECORATOR]


@pytest.mark.parametrize("module", INNER, ids=name_of)
def test_inner_layers_open_no_file(module):
    assert called(module) & FILE_CALLS == set()
    assert imported(module) & {"os", "io", "rasterio", "osgeo", "dask", "pyogrio", "tempfile"} == set()


@every_module
def test_kernels_are_compiled_by_our_decorator_only(module):
    if name_of(module) != DECORATOR:
        assert not re.search(r"@(numba\.)?(n?jit|vectorize|guvectorize)\b", module.read_text(encoding="utf-8"))
