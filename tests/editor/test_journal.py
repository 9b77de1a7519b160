"""Test that a journal on a full disk has whole changes only."""

import json
import subprocess
import sys

from smartview_jax.editor.journal import Journal

FULL_DISK = """
import resource, signal, sys
from pathlib import Path
from smartview_jax.editor.journal import Journal

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
path = Path(sys.argv[1])
journal = Journal(path, {"views": ["v1"]})
journal.append({"do": "first"})
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
resource.setrlimit(resource.RLIMIT_FSIZE, (path.stat().st_size + 20, hard))
try:
    journal.append({"do": "refused", "text": "x" * 100})
except OSError:
    print("refused")
resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
journal.append({"do": "next"})
journal.close()
"""


def test_refused_change_does_not_come_out_with_the_next(tmp_path):
    """A write that the system refuses midway leaves neither bytes in the file nor in a buffer."""
    path = tmp_path / "model.journal"
    job = subprocess.run(
        [sys.executable, "-c", FULL_DISK, str(path)], capture_output=True, text=True, check=True
    )
    assert job.stdout == "refused\n"
    entries = [json.loads(line) for line in path.read_text().splitlines()]
    assert [entry.get("do") for entry in entries] == [None, "first", "next"]
    journal = Journal(path, {"views": ["v1"]})
    journal.close()
    assert [entry["do"] for entry in journal.entries] == ["first", "next"]
