"""Every public callable has an example; it and every other one runs and prints what it says."""

import ast
import doctest
import functools
import importlib
import inspect
from pathlib import Path

import pytest

import smartview_jax as sv

MAX_SKIPPED = 10
"""Number of lines that may be marked not to be run, because they take too long for a test."""

CALLABLES = [
    name
    for name in sv.__all__
    if callable(getattr(sv, name)) and not inspect.ismodule(getattr(sv, name))
]


def examples_of(text, name, given):
    """The examples of a docstring, which begin with the given names."""
    return doctest.DocTestParser().get_doctest(text, given, name, None, 0)


def failures(test):
    """What the examples of a docstring print that they should not; nothing if all is as said."""
    said = []
    runner = doctest.DocTestRunner(verbose=False)
    runner.run(test, out=said.append, clear_globs=False)
    return "".join(said)


@pytest.fixture(scope="module")
def names_of_package():
    """What the example of the package's own docstring makes."""
    test = examples_of(sv.__doc__, "smartview_jax", {})
    said = failures(test)
    assert not said, said
    return test.globs


@pytest.mark.parametrize("name", CALLABLES)
def test_the_example_of_a_public_name_prints_what_it_says(name, names_of_package):
    public = getattr(sv, name)
    test = examples_of(public.__doc__, name, dict(names_of_package))
    assert test.examples, f"the docstring of sv.{name} has no example"
    called = any(f"sv.{name}(" in example.source for example in test.examples)
    assert called or inspect.isclass(public), f"the example of sv.{name} does not call it"
    said = failures(test)
    assert not said, said


PACKAGE = Path(sv.__file__).parent


def documented(node, parents=()):
    """The names of everything in a file that has an example, a method's after its class's."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef | ast.FunctionDef):
            names = (*parents, child.name)
            if ">>> " in (ast.get_docstring(child) or ""):
                yield ".".join(names)
            yield from documented(child, names)


OTHERS = {
    (".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts), name)
    for file in PACKAGE.rglob("*.py")
    if ">>> " in (text := file.read_text(encoding="utf-8"))
    for name in documented(ast.parse(text))
} - {(getattr(sv, name).__module__, getattr(sv, name).__qualname__) for name in CALLABLES}
"""Module and name of what has an example although it is no public name of the package itself."""


@pytest.mark.parametrize(("module", "name"), sorted(OTHERS))
def test_the_example_of_a_method_or_of_a_room_prints_what_it_says(module, name, names_of_package):
    documented_object = functools.reduce(getattr, name.split("."), importlib.import_module(module))
    said = failures(examples_of(documented_object.__doc__, name, dict(names_of_package)))
    assert not said, said


def test_few_lines_are_not_run():
    skipped = [
        f"{name}: {example.source.strip()}"
        for name in CALLABLES
        for example in examples_of(getattr(sv, name).__doc__, name, {}).examples
        if example.options.get(doctest.SKIP)
    ]
    assert len(skipped) <= MAX_SKIPPED, "\n".join(skipped)
