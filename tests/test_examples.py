"""Every public callable has an example in its docstring, which runs and prints what it says."""

import doctest
import inspect

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


def test_few_lines_are_not_run():
    skipped = [
        f"{name}: {example.source.strip()}"
        for name in CALLABLES
        for example in examples_of(getattr(sv, name).__doc__, name, {}).examples
        if example.options.get(doctest.SKIP)
    ]
    assert len(skipped) <= MAX_SKIPPED, "\n".join(skipped)
