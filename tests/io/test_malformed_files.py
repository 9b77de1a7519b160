import pytest

from benchmarks.fuzz import campaign, mutated
from benchmarks.fuzz_formats import FORMATS

BUDGET = 20
"""Malformed files of each format; `python -m benchmarks fuzz` reads ten thousand."""


@pytest.mark.parametrize("name", FORMATS)
def test_a_malformed_file_is_named_or_its_values_are_in_range(name, tmp_path, monkeypatch):
    monkeypatch.setattr("benchmarks.fuzz.FORMATS", {name: FORMATS[name]})
    findings = campaign(tmp_path, BUDGET, seed=sorted(FORMATS).index(name))
    assert not [(finding.words, finding.content) for finding in findings]


@pytest.mark.parametrize(
    ("read", "words"),
    [
        (lambda path: {}["entry"], "KeyError: 'entry'"),
        (lambda path: int("x"), "unnamed ValueError: invalid literal"),
        (lambda path: path.read_text(encoding="utf-8").encode("ascii"), "unnamed Unicode"),
        (lambda path: 0.0, "out of range: zero"),
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
    )
    monkeypatch.setattr("benchmarks.fuzz.FORMATS", {"file": kind})
    monkeypatch.setattr("benchmarks.fuzz.mutated", lambda *_: "größer: 1\n".encode())
    (finding,) = campaign(tmp_path, 1, seed=0)
    assert words in finding.words


def test_mutations_are_the_same_for_the_same_seed():
    import random

    text = b"a: [1, 2]\nb: {c: 3}\n"
    first = [mutated(text, random.Random(seed)) for seed in range(50)]
    assert first == [mutated(text, random.Random(seed)) for seed in range(50)]
    assert len(set(first)) > 30
