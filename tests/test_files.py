import os

import pytest

from smartview_jax.files import dump_yaml, read_yaml, write_atomically


def test_what_is_written_is_read_back(tmp_path):
    content = {"b": [1.0, 2.5], "a": {"text": "°", "none": None}}
    path = write_atomically(tmp_path / "new" / "file.yaml", dump_yaml(content))
    assert read_yaml(path) == content
    assert list(read_yaml(path)) == ["b", "a"]


def test_an_interrupted_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    path = write_atomically(tmp_path / "result.yaml", "old: 1\n")

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, "new: 2\n")
    assert path.read_text() == "old: 1\n"
    assert [p.name for p in tmp_path.iterdir()] == ["result.yaml"]


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nowhere\.yaml: no such file"):
        read_yaml(tmp_path / "nowhere.yaml")


@pytest.mark.parametrize(
    ("text", "message"),
    [("a: [1", "not readable as YAML"), ("- 1\n- 2\n", "expected a mapping, found list")],
)
def test_a_wrong_file_is_named(tmp_path, text, message):
    (tmp_path / "wrong.yaml").write_text(text)
    with pytest.raises(ValueError, match=rf"wrong\.yaml: {message}"):
        read_yaml(tmp_path / "wrong.yaml")


def test_yaml_that_would_run_code_is_refused(tmp_path):
    (tmp_path / "evil.yaml").write_text("a: !!python/object/apply:os.system ['true']\n")
    with pytest.raises(ValueError, match="not readable as YAML"):
        read_yaml(tmp_path / "evil.yaml")
