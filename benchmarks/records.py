"""Records of a long benchmark, a line of JSON each, with which it goes on after an interruption."""

import json
from pathlib import Path
from typing import Any


def read_records(path: Path | None) -> list[dict[str, Any]]:
    """Return the records of a file, if there is one, without a line that was cut off."""
    records = []
    lines = [] if path is None or not path.is_file() else path.read_text("utf-8").splitlines()
    for line in lines:
        try:
            records.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return records


def append_record(path: Path | None, record: dict[str, Any]) -> None:
    """Append a record to a file; without a file do nothing."""
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    # One write of a whole line: several processes append to one file.
    with path.open("ab", buffering=0) as file:
        file.write(f"{json.dumps(record)}\n".encode())
