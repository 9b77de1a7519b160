"""Test that a journal on a full disk has whole changes only."""

import contextlib
import json
import resource
import signal

import pytest

from smartview_jax.editor.journal import Journal


@contextlib.contextmanager
def room_for(size):
    """Files of this process cannot grow beyond a size: as on a full disk, a write ends midway."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    told = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, told)


def test_refused_change_does_not_come_out_with_the_next(tmp_path):
    """A write that the system refuses midway leaves neither bytes in the file nor in a buffer."""
    path = tmp_path / "model.journal"
    journal = Journal(path, {"views": ["v1"]})
    journal.append({"do": "first"})
    with room_for(path.stat().st_size + 20), pytest.raises(OSError, match="File too large"):
        journal.append({"do": "refused", "text": "x" * 100})
    journal.append({"do": "next"})
    journal.close()
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    assert [entry.get("do") for entry in entries] == [None, "first", "next"]
    journal = Journal(path, {"views": ["v1"]})
    journal.close()
    assert [entry["do"] for entry in journal.entries] == ["first", "next"]


HEADER = {"views": ["v1"]}


@pytest.mark.parametrize(
    "content",
    [
        b"a letter, not a journal",
        b"a letter, not a journal\n",
        b'{"smartview_journal": 1, "views": ["v2"]}',
        b'{"smartview_journal": 1, "views": ["v1"]}\r{"do": "first"}\r',
        b'{"smartview_journal": 1, "views": ["v1"]}\n{"do": "first"}\r{"do": "next"}\r',
    ],
)
def test_what_was_not_torn_is_named_and_left_as_it_is(tmp_path, content):
    """Another program's file and line ends of another system are no torn lines to be cut off."""
    path = tmp_path / "model.journal"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.journal: line \d .*not a"):
        Journal(path, HEADER)
    assert path.read_bytes() == content


def test_a_last_line_that_lost_only_its_end_is_kept(tmp_path):
    """Some editors write no last line end."""
    path = tmp_path / "model.journal"
    path.write_bytes(b'{"smartview_journal": 1, "views": ["v1"]}\n{"do": "first"}')
    for _ in range(2):
        journal = Journal(path, HEADER)
        journal.append({"do": "next"})
        journal.close()
        assert journal.cut_off == 0
    assert [entry["do"] for entry in journal.entries] == ["first", "next"]


def test_a_torn_first_line_is_begun_again(tmp_path):
    path = tmp_path / "model.journal"
    path.write_bytes(b'{"smartview_journal": 1, "vi')
    journal = Journal(path, HEADER)
    journal.close()
    assert path.read_bytes() == b'{"smartview_journal": 1, "views": ["v1"]}\n'
