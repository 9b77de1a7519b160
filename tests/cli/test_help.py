"""The help of every subcommand is complete at 80 columns, and options say what they expect."""

import inspect
import re
import subprocess
import sys
from enum import Enum
from typing import get_args

import pytest
import typer
from board_scene import run
from main_job import user_environment
from typer.models import OptionInfo

from smartview_jax.cli import app
from smartview_jax.cli.options import options_of, parse_numbers

COMMAND = typer.main.get_command(app)

UNITS = re.compile(r"\b(m|mm|degrees|px|number|fraction|port)\b|%", flags=re.IGNORECASE)


def options():
    """Name, type and help of every option that takes a value, for each subcommand."""
    for verb, command in COMMAND.commands.items():
        for parameter in options_of(inspect.unwrap(command.callback)):
            kind, *stated = get_args(parameter.annotation) or (None,)
            if stated and isinstance(stated[0], OptionInfo) and bool not in (kind, *get_args(kind)):
                yield pytest.param(kind, stated[0].help, id=f"{verb} {parameter.name}")


@pytest.mark.parametrize("verb", ["", *COMMAND.commands])
def test_no_word_of_the_help_is_cut_at_80_columns(verb, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = run(*verb.split(), "--help").stdout.splitlines()
    assert max(map(len, lines)) <= 80
    assert not [line for line in lines if "\u2026" in line or line.endswith("-")]
    text = " ".join(" ".join(lines).split())
    command = COMMAND.commands[verb] if verb else COMMAND
    for parameter in command.params:
        assert " ".join((parameter.help or "").split()) in text
    if not verb:
        for named in COMMAND.commands.values():
            assert " ".join(named.help.partition("\n\n")[0].split()) in text


@pytest.mark.parametrize(("kind", "words"), list(options()))
def test_an_option_says_unit_and_example(kind, words):
    kinds = {kind, *get_args(kind)}
    for part in tuple(kinds):
        kinds |= set(get_args(part))
    # Choices are listed by the help itself.
    choices = any(isinstance(part, type) and issubclass(part, Enum) for part in kinds)
    assert choices or "such as " in words
    if {int, float} & kinds:
        assert UNITS.search(words)


@pytest.mark.parametrize("text", ["0.1,0,-0.2", "(0.1, 0, -0.2)", " 0.1, 0,-0.2 "])
def test_a_vector_is_numbers_between_commas_also_as_it_is_printed(text):
    assert parse_numbers("--at", text, 3, "x,y,z (m)") == (0.1, 0.0, -0.2)


@pytest.mark.parametrize("text", ["0.1", "0.1 0 -0.2", "0,0,nan", "0,0,0,0", "", "0,0,m"])
def test_anything_else_is_refused_with_what_is_expected(text):
    with pytest.raises(ValueError, match=r"--at: expected 3 numbers between commas, x,y,z \(m\)"):
        parse_numbers("--at", text, 3, "x,y,z (m)")


def test_three_words_are_refused_with_what_is_expected(tmp_path):
    ended = run("viewpoint", "nowhere.yaml", "--at", "0.1", "0", "0")
    assert ended.exit_code == 2
    assert "Traceback" not in ended.output


def test_the_package_runs_as_a_module():
    ended = subprocess.run(
        [sys.executable, "-m", "smartview_jax", "--version"],
        env=user_environment(),
        capture_output=True,
        text=True,
    )
    assert (ended.returncode, ended.stdout[:13]) == (0, "smartview_jax")
