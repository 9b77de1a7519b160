"""Every docstring begins with a sentence that says what the thing is or does.

The rule is the same everywhere. A function's first sentence begins with a verb ("Return", "Fit",
"Solve"); a property's or a class's may name what it is ("The hand-eye transform.", "A lens
with radial distortion."). No first sentence begins with a word that leaves open what is meant.
"""

import ast
import importlib
import inspect
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest
from test_layers import FILES as ROOM_FILES
from test_layers import PACKAGE, tree_of

FILES = [PACKAGE / "__init__.py", *ROOM_FILES]

RIDDLES = set("Of What How Those These That There Which Whose Where When From One Ones It".split())
ARTICLES = {"A", "An", "The"}

SMALLEST_DOCUMENTED_FRACTION = 0.95
"""Of public functions, classes and methods, those that have a docstring or inherit one."""


class Described(NamedTuple):
    """A thing that has a docstring, and the first sentence of it."""

    where: str
    node: ast.AST
    sentence: str

    @property
    def names_a_thing(self) -> bool:
        """Whether this is a class, or a property, which is read like a variable."""
        if isinstance(self.node, ast.ClassDef):
            return True
        decorators = getattr(self.node, "decorator_list", ())
        return any("property" in ast.unparse(one) for one in decorators)


@cache
def definitions(tree: ast.AST) -> list[ast.AST]:
    kinds = (ast.Module, ast.ClassDef, ast.FunctionDef)
    return [node for node in ast.walk(tree) if isinstance(node, kinds)]


def described(tree: ast.AST, file: str) -> Iterator[Described]:
    for node in definitions(tree):
        text = ast.get_docstring(node)
        if text:
            sentence = re.split(r"(?<=[.!?])\s|\n\n", text)[0].replace("\n", " ")
            yield Described(f"{file}: {getattr(node, 'name', 'module')}", node, sentence)


def faults(one: Described) -> list[str]:
    """What is wrong with a first sentence."""
    first = one.sentence.split()[0].strip(",:;")
    found = []
    if not one.sentence.endswith("."):
        found.append("does not end with a full stop")
    if first in RIDDLES:
        found.append(f"begins with {first!r}")
    if first.islower() or not first[0].isalpha():
        found.append("does not begin with a capital letter")
    if isinstance(one.node, ast.FunctionDef) and not one.names_a_thing and first in ARTICLES:
        found.append("names a thing where a function should say what it does")
    if len(one.sentence.split()) < 3 and not one.names_a_thing:
        found.append("has fewer than three words")
    return found


def test_first_sentences_say_what_a_thing_is_or_does():
    found = [
        f"{one.where}: {one.sentence!r} {', '.join(wrong)}"
        for file in FILES
        for one in described(tree_of(file), str(file.relative_to(PACKAGE)))
        if (wrong := faults(one))
    ]
    assert not found, "\n".join(found)


@pytest.mark.parametrize(
    ("code", "fault"),
    [
        ('def f():\n    """Of a view."""', "begins with 'Of'"),
        ('def f():\n    """The pose of a view."""', "names a thing"),
        ('class C:\n    """What a view says."""', "begins with 'What'"),
        ('def f():\n    """Return the pose"""', "full stop"),
        ('def f():\n    """Poses."""', "fewer than three words"),
        ('def f():\n    """return the pose."""', "capital"),
    ],
)
def test_the_lint_finds_what_it_is_for(code, fault):
    (one,) = described(ast.parse(code), "f.py")
    assert any(fault in wrong for wrong in faults(one))


def test_public_names_have_docstrings():
    """A method that overrides a documented one need not repeat its docstring."""
    documented, missing = 0, []
    for file in FILES:
        for parent in definitions(tree_of(file)):
            if isinstance(parent, ast.FunctionDef) or getattr(parent, "name", "x")[0] == "_":
                continue
            for node in parent.body:
                if not isinstance(node, ast.FunctionDef | ast.ClassDef) or node.name[0] == "_":
                    continue
                if ast.get_docstring(node) or _inherits_docstring(file, parent, node):
                    documented += 1
                else:
                    missing.append(f"{file.relative_to(PACKAGE)}: {node.name}")
    fraction = documented / (documented + len(missing))
    assert fraction >= SMALLEST_DOCUMENTED_FRACTION, missing


def _inherits_docstring(file: Path, parent: ast.AST, node: ast.AST) -> bool:
    if not isinstance(parent, ast.ClassDef):
        return False
    module = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts)
    owner = getattr(importlib.import_module(module), parent.name)
    return inspect.getdoc(inspect.getattr_static(owner, node.name)) is not None


def test_the_papers_equations_are_found_by_their_number():
    """By searching for "Eq. N", not hidden in a range."""
    found = {
        int(number)
        for file in FILES
        for number in re.findall(r"\bEq\.\s(\d+)\b", file.read_text(encoding="utf-8"))
    }
    assert found >= set(range(1, 21))
