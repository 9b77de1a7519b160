import json
import os
import signal

import numpy as np
import pytest
import yaml

from smartview_jax.files import (
    dump_json,
    dump_yaml,
    file_transaction,
    finite_or_null,
    folder_transaction,
    read_yaml,
    write_atomically,
)


def test_what_is_written_is_read_back(tmp_path):
    content = {"b": [1.0, 2.5], "a": {"text": "°", "none": None}}
    path = write_atomically(tmp_path / "new" / "file.yaml", dump_yaml(content))
    assert read_yaml(path) == content
    assert list(read_yaml(path)) == ["b", "a"]


TEXTS = [
    *"1e3 yes Null ~ 001 0o7 1:30 2001-01-01 .5 0x1f <<".split(),
    *("a: b", "- a", "a #b", " a ", "a\tb", "a\nb", "a\xa0b", "a\u2028b", "a\x85b", "\x7f"),
    *("\U0001f600", "\ufeffa", "\u200fa", "'", '"', "", "x y " * 100),
]


@pytest.mark.parametrize("dump", [dump_yaml, dump_json])
def test_texts_are_read_back_equal_by_both_versions_of_yaml(tmp_path, dump):
    content = {"texts": TEXTS, "numbers": [1, 2.5, 1e-5, 1e22, True, None]}
    path = write_atomically(tmp_path / "file", dump(content))
    assert read_yaml(path) == content
    assert yaml.safe_load(dump({"texts": TEXTS})) == {"texts": TEXTS}


def test_an_interrupted_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = write_atomically(tmp_path / "result.yaml", "old: 1\n")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, "new: 2\n")
    assert path.read_text() == "old: 1\n"
    assert [p.name for p in tmp_path.iterdir()] == ["result.yaml"]


def test_a_full_disk_is_reported_with_the_final_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*/results/a\.yaml'"):
        write_atomically(tmp_path / "results" / "a.yaml", "new: 2\n")
    with (
        pytest.raises(OSError, match=r"No space left on device: '.*/results/b\.yaml'"),
        file_transaction(tmp_path / "results") as temporary,
    ):
        write_atomically(temporary / "b.yaml", "new: 2\n")


@pytest.mark.parametrize("exists", [False, True])
def test_a_folder_is_written_whole_or_not_at_all(tmp_path, exists):
    folder = tmp_path / "new" / "data"
    if exists:
        folder.mkdir(parents=True)
    interrupted = folder_transaction(folder)
    (interrupted.__enter__() / "half.txt").write_text("half")
    assert not interrupted.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    assert list((tmp_path / "new").iterdir()) == [folder][: int(exists)]
    with folder_transaction(folder) as temporary:
        (temporary / "images").mkdir()
        (temporary / "images" / "1.png").write_bytes(b"1")
    assert [path.name for path in (tmp_path / "new").iterdir()] == ["data"]
    assert (folder / "images" / "1.png").read_bytes() == b"1"
    assert folder.stat().st_mode & 0o777 == 0o755
    with pytest.raises(FileExistsError, match="nothing is overwritten"):
        folder_transaction(folder).__enter__()


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yaml: no such file"):
        read_yaml(tmp_path / "nowhere.yaml")
    with pytest.raises(FileNotFoundError, match="is a folder, expected a file"):
        read_yaml(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: [1", "not readable as YAML"),
        ("- 1\n- 2\n", "expected a mapping, found list"),
        ("# nothing but a comment\n", "the file is empty"),
        ("a: 1\nb: 2\na: 3\n", "not readable as YAML: key 'a' comes twice"),
        ("a: " + 2000 * "[" + 2000 * "]", "not readable as YAML: nested deeper"),
        ("a: &a [*a]\n", "not readable as YAML: an alias to a node that contains it"),
        ("a: !!bool maybe\n", "not readable as YAML"),
        ("a: !!int ''\n", "not readable as YAML"),
        ("a: 1\n\tb: 2\n", "not readable as YAML: .* a line begins with a tab; YAML wants spaces"),
        ("a: " + 5000 * "1" + "\n", "not readable as YAML: Exceeds the limit"),
        ("a: \x00\n", "not readable as YAML"),
        ("a: {x: 0,5, y: 1}\n", "not readable as YAML: number 5 without a name .*decimal comma"),
    ],
)
def test_a_wrong_file_is_named(tmp_path, text, message):
    (tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"wrong\.yaml: {message}"):
        read_yaml(tmp_path / "wrong.yaml")


def test_yaml_that_would_run_code_is_refused(tmp_path):
    (tmp_path / "evil.yaml").write_text("a: !!python/object/apply:os.system ['true']\n")
    with pytest.raises(ValueError, match="not readable as YAML"):
        read_yaml(tmp_path / "evil.yaml")


def test_aliases_that_multiply_are_refused_before_they_do(tmp_path):
    """Nine levels of nine aliases are a thousand million entries."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{k}: &a{k} [{', '.join(9 * [f'*a{k - 1}'])}]" for k in range(1, 9)]
    (tmp_path / "bomb.yaml").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"bomb\.yaml: .*more than 1000000 entries"):
        read_yaml(tmp_path / "bomb.yaml")


def test_bytes_that_are_no_text_are_named(tmp_path):
    (tmp_path / "latin.yaml").write_bytes("größe: 1\n".encode("latin-1"))
    with pytest.raises(ValueError, match=r"latin\.yaml: not readable as UTF-8 text: .*position 2"):
        read_yaml(tmp_path / "latin.yaml")


def test_numbers_are_those_of_yaml_1_2(tmp_path):
    """The older version reads text, eight and ninety."""
    (tmp_path / "numbers.yaml").write_text("a: [1e-3, 010, 1:30, -.inf, 1_000, 2024-01-01, .5]\n")
    found = read_yaml(tmp_path / "numbers.yaml")["a"]
    assert found == [1e-3, 10, "1:30", -float("inf"), "1_000", "2024-01-01", 0.5]


def test_infinity_and_nan_are_null():
    numbers = [np.float64(0.5), 2, float("inf"), -float("inf"), float("nan")]
    plain = [finite_or_null(number) for number in numbers]
    assert plain == [0.5, 2.0, None, None, None]
    assert json.dumps(plain, allow_nan=False)


def test_results_of_two_runs_never_stand_side_by_side(tmp_path, monkeypatch):
    for name in ("a", "b"):
        (tmp_path / name).write_text("old")
    (tmp_path / "another's").write_text("kept")
    with pytest.raises(IsADirectoryError), file_transaction(tmp_path, ["a", "b"]) as folder:
        folder.write_text("in vain")
    assert (tmp_path / "a").read_text() == "old"

    replace = os.replace

    def interrupted(*paths):
        replace(*paths)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt), file_transaction(tmp_path, ["a", "b"]) as folder:
        (folder / "a").write_text("new")
    assert (tmp_path / "a").read_text() == "new"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "another's"]
