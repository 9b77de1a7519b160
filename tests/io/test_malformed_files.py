import random

import numpy as np
import pytest

from benchmarks.fuzz import campaign, mutated, refuse_other_values, values_of
from benchmarks.fuzz_formats import FORMATS
from benchmarks.fuzz_meshes import GLB, PLY, STL
from benchmarks.fuzz_numbers import NUMBERS
from benchmarks.fuzz_pictures import JPEG
from benchmarks.fuzz_png import PNG
from benchmarks.fuzz_text import ENCODINGS, TABLES, Mutation
from benchmarks.fuzz_trees import TREES

BUDGET = 20
"""Malformed files of each format; `python -m benchmarks fuzz` reads ten thousand."""


@pytest.mark.parametrize("name", FORMATS)
def test_a_malformed_file_is_named_or_its_values_are_in_range(name, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.fuzz.FORMATS", {name: FORMATS[name]})
    tally = campaign(tmp_path, BUDGET, seed=sorted(FORMATS).index(name))
    assert not [(finding.words, finding.kinds, finding.content) for finding in tally.findings]


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (lambda path: {}["entry"], "KeyError: 'entry'"),
        (lambda path: int("x"), "unnamed ValueError: invalid literal"),
        (lambda path: path.read_text(encoding="utf-8").encode("ascii"), "unnamed Unicode"),
        (lambda path: 0.0, "out of range: zero"),
        (lambda path: 7.0, "out of range: another value"),
        (lambda path: [1.0, 1.0], "out of range: 2 numbers"),
    ],
)
def test_the_campaign_sees_what_goes_wrong(read, words, tmp_path, monkeypatch):
    """A check that cannot fail is no check."""

    def refuse(value):
        assert value, "zero"

    whole = "größe: 1\n"
    kind = FORMATS["calibration"]._replace(
        write=lambda folder: folder.joinpath("f.yaml").write_text(whole) and folder / "f.yaml",
        read=lambda path: 1.0 if path.read_text("utf-8", "ignore") == whole else read(path),
        refuse_out_of_range=refuse,
        mutations={"word": Mutation(lambda *_: "größer: 1\n".encode(), keeps_values=True)},
    )
    monkeypatch.setattr("benchmarks.fuzz.FORMATS", {"file": kind})
    monkeypatch.setattr("benchmarks.fuzz.together", lambda contents: {})
    (finding,) = campaign(tmp_path, 1, seed=0).findings
    assert words in finding.words
    assert set(finding.kinds) == {"word"}


def test_mutations_are_the_same_for_the_same_seed():
    text = b"a: [1.5, 2]\nb: {c: 3.25}\n"
    kinds = ENCODINGS | NUMBERS | TABLES | TREES

    def drawn():
        return [mutated(text, random.Random(seed), kinds, "cut") for seed in range(50)]

    assert drawn() == drawn()
    assert len(set(drawn())) > 30


def test_there_are_many_kinds_of_mistakes_and_each_has_a_place(tmp_path):
    """39 of text were asked for; a kind that finds no place in any good file would try nothing."""
    text = ENCODINGS | NUMBERS | TABLES | TREES
    assert len(text) >= 39
    contents = {}
    for name in ("dataset", "poses", "joints", "object", "PNG", "JPEG", "STL", "PLY", "glTF"):
        (tmp_path / name).mkdir()
        contents[name] = FORMATS[name].write(tmp_path / name).read_bytes()
    for kind, mutation in (text | PNG | JPEG | STL | PLY | GLB).items():
        assert any(
            mutation.change(content, random.Random(seed)) not in (None, content)
            for content in contents.values()
            for seed in range(5)
        ), kind


def test_all_numbers_are_compared():
    good = values_of({"a": (1.0, np.arange(3)), "b": "text"})
    refuse_other_values(values_of({"a": (1.0, np.arange(3)), "b": "other"}), good)
    with pytest.raises(AssertionError, match="another value"):
        refuse_other_values(values_of({"a": (1.0, np.arange(1, 4)), "b": "text"}), good)
