"""Names of parameters and fields, read from the annotations of a package: one noun for each class.

    python tests/support/annotated_names.py [FOLDER]

prints every name that is not its class's noun.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Set
from functools import cache
from pathlib import Path
from typing import NamedTuple


class AnnotatedName(NamedTuple):
    """A parameter or field whose annotation names a class of the package."""

    place: str  # file:line, below the folder of the package
    name: str
    class_name: str
    is_collection: bool  # a tuple, list or mapping of objects of the class


# Wrappers of one object: `X | None`, Optional[X], Annotated[X, ...], Final[X].
OF_ONE = {"Optional", "Annotated", "Final", "ClassVar", "Required", "NotRequired", "type"}
# The types of what is called back say nothing about a name.
SKIPPED = {"Callable", "Literal"}


def class_definitions(folder: Path) -> dict[str, list[str]]:
    """Places (file:line) of each class of a package, by its name; classes inside functions and classes included."""
    places = defaultdict(list)
    for path, tree in modules(folder):
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                places[node.name].append(f"{path}:{node.lineno}")
    return dict(places)


def bases_of_classes(folder: Path) -> dict[str, set[str]]:
    """Names of the classes that each class of a package is derived from, directly or not."""
    direct = defaultdict(set)
    for _, tree in modules(folder):
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                direct[node.name] |= {name for base in node.bases for name, _ in classes_in(base)}
    bases = {}
    for class_name in direct:
        bases[class_name], waiting = set(), [class_name]
        while waiting:
            new = direct.get(waiting.pop(), set()) - bases[class_name]
            bases[class_name] |= new
            waiting += new
    return bases


def annotated_names(folder: Path) -> list[AnnotatedName]:
    """Every parameter, and every annotated field or variable, whose annotation names a public class of the package.

    A method's `other` of its own class is left out: Python's usual name of a second operand.
    """
    classes = {name for name in class_definitions(folder) if not name.startswith("_")}
    return [
        AnnotatedName(f"{path}:{line}", name, class_name, is_collection)
        for path, tree in modules(folder)
        for line, name, annotation, own_class in annotations(tree)
        for class_name, is_collection in classes_in(annotation)
        if class_name in classes and (name, class_name) != ("other", own_class)
    ]


def modules(folder: Path) -> Iterator[tuple[str, ast.Module]]:
    """Path below the folder and syntax tree of every module."""
    for module in sorted(folder.rglob("*.py")):
        yield module.relative_to(folder).as_posix(), tree_of(module.read_text(encoding="utf-8"))


@cache
def tree_of(text: str) -> ast.Module:
    """Syntax tree of a module's text, which nobody changes."""
    return ast.parse(text)


def annotations(tree: ast.AST, own_class: str = "") -> Iterator[tuple[int, str, ast.expr, str]]:
    """Line, name, annotation and surrounding class of every parameter, field and variable that has an annotation."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.arg) and node.annotation is not None:
            yield node.lineno, node.arg, node.annotation, own_class
        elif isinstance(node, ast.AnnAssign):
            if isinstance(node.target, ast.Name):
                yield node.lineno, node.target.id, node.annotation, own_class
            elif isinstance(node.target, ast.Attribute):
                yield node.lineno, node.target.attr, node.annotation, own_class
        yield from annotations(node, node.name if isinstance(node, ast.ClassDef) else own_class)


def classes_in(annotation: ast.expr, in_collection: bool = False) -> Iterator[tuple[str, bool]]:
    """Names of the classes in an annotation, and whether each stands inside a collection.

    Of mappings only the values count: what they are keyed by is said by `by_...` or not at all.
    """
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        yield from classes_in(ast.parse(annotation.value, mode="eval").body, in_collection)
    elif isinstance(annotation, ast.Name):
        yield annotation.id, in_collection
    elif isinstance(annotation, ast.Attribute):
        yield annotation.attr, in_collection
    elif isinstance(annotation, ast.BinOp):
        yield from classes_in(annotation.left, in_collection)
        yield from classes_in(annotation.right, in_collection)
    elif isinstance(annotation, ast.Subscript):
        outer = next(classes_in(annotation.value), ("", False))[0]
        if outer in SKIPPED:
            return
        inner = annotation.slice.elts if isinstance(annotation.slice, ast.Tuple) else [annotation.slice]
        if outer in ("dict", "Mapping", "MutableMapping", "OrderedDict", "defaultdict"):
            inner = inner[1:]
        if outer == "Annotated":
            inner = inner[:1]
        yield outer, in_collection
        for each in inner:
            yield from classes_in(each, in_collection or outer not in OF_ONE)


def snake_case(class_name: str) -> str:
    """`MatchScene` -> match_scene, `RPCFile` -> rpc_file; a leading underscore is dropped."""
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", class_name.lstrip("_"))
    return words.lower()


def plural(noun: str) -> str:
    """`view` -> views, `box` -> boxes, `entry` -> entries, `locus` -> loci, `options` -> options."""
    if noun.endswith(("options", "data")):
        return noun
    if noun.endswith("locus"):
        return noun[: -len("us")] + "i"
    if noun.endswith("s") and not noun.endswith("ss"):
        return noun
    if re.search(r"[^aeiou]y$", noun):
        return noun[:-1] + "ies"
    return noun + ("es" if re.search(r"(s|x|z|ch|sh)$", noun) else "s")


def is_named_after(name: str, noun: str, is_collection: bool) -> bool:
    """Whether a name is the noun, alone or with a prefix or a suffix (`coarser_surface`, `view_a`).

    Collections bear the plural; a mapping may keep the singular where the suffix says what it is keyed by
    (`view_of_name`).
    """
    nouns = {noun, plural(noun)} if is_collection else {noun}
    words = name.lstrip("_").lower()
    return any(re.search(rf"(^|_){each}($|_)", words) for each in nouns)


def possible_nouns(class_name: str, taken: Collection[str] = ()) -> list[str]:
    """The class's name in snake case and its last words, longest first (oriented_scene, scene), less those taken."""
    words = snake_case(class_name).split("_")
    nouns = ["_".join(words[first:]) for first in range(len(words))]
    return [noun for noun in nouns if noun == nouns[0] or noun not in taken]


def nouns_of(class_name: str, bases: Mapping[str, Set[str]], nouns: Mapping[str, tuple[str, ...]]) -> list[str]:
    """The nouns of which one must be in the names of all variables of a class.

    bases : of every class. nouns : of the classes that are not called by their own name. The other classes are called
    by their name or its last words (`request` of DsmRequest), where these are not the noun of another public class that
    is no base.
    """
    others = {name for name in bases.keys() - {class_name} - bases[class_name] if not name.startswith("_")}
    taken = {noun for name in others for noun in nouns.get(name, (snake_case(name),))}
    return possible_nouns(class_name, taken)


def wrongly_named(folder: Path, nouns: Mapping[str, tuple[str, ...]]) -> list[AnnotatedName]:
    """The names that are not their class's noun: any of those in `nouns`, else the one of `nouns_of` that fits best.

    Options of a stage are `options`, or have the name of the stage.
    """
    names = defaultdict(list)
    for each in annotated_names(folder):
        names[each.class_name].append(each)
    bases, wrong = bases_of_classes(folder), []
    for class_name, of_class in names.items():
        if class_name in nouns or class_name.endswith("Options"):
            choices = [nouns.get(class_name) or ("options", snake_case(class_name)[: -len("_options")])]
        else:
            choices = [(noun,) for noun in nouns_of(class_name, bases, nouns)]
        not_called = ([e for e in of_class if not is_named_after_any(e, choice)] for choice in choices)
        wrong += min(not_called, key=len)
    return wrong


def is_named_after_any(name: AnnotatedName, nouns: tuple[str, ...]) -> bool:
    """Whether a name bears one of the nouns."""
    return any(is_named_after(name.name, noun, name.is_collection) for noun in nouns)


if __name__ == "__main__":
    root = Path(__file__).parents[2]
    sys.path[:0] = [str(root / "tests")]
    from test_architecture import NOUNS

    package = Path(sys.argv[1]) if sys.argv[1:] else root / "src" / "zlocus"
    for found in wrongly_named(package, NOUNS):
        print(f"{found.place}: {found.name}: {found.class_name}{' (several)' if found.is_collection else ''}")
