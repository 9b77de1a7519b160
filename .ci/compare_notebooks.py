"""Compare notebooks that were just executed with the outputs that are committed.

Usage: python .ci/compare_notebooks.py EXECUTED_FOLDER COMMITTED_NOTEBOOK ...

Every cell must give outputs of the same kinds (text, picture, table), the same words, and numbers
that agree to two digits. Of a cell with the tag `varies` only the kinds are compared.
"""

import json
import math
import re
import sys
from pathlib import Path

RELATIVE_TOLERANCE = 0.05
"""Largest relative difference of two numbers that agree to two digits."""

NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def outputs_of(cell: dict) -> tuple[list[str], str]:
    """Return the kinds of a cell's outputs, pieces of one stream as one, and all its text."""
    kinds, texts = [], []
    for output in cell["outputs"]:
        if output["output_type"] == "stream":
            # What a library says on stderr depends on the machine.
            if output["name"] == "stdout":
                kinds += ["text"] if kinds[-1:] != ["text"] else []
                texts.append("".join(output["text"]))
        elif output["output_type"] == "error":
            kinds.append(f"error {output['ename']}")
        else:
            kinds.append(" ".join(sorted(output["data"])))
            if "image/png" not in output["data"]:
                texts.append("".join(output["data"].get("text/plain", "")))
    return kinds, "".join(texts)


def difference(committed: str, executed: str) -> str | None:
    """Return what differs between two texts; None if words agree, and numbers to two digits."""
    words = [NUMBER.sub("#", text).split() for text in (committed, executed)]
    if words[0] != words[1]:
        found = next((pair for pair in zip(*words, strict=False) if pair[0] != pair[1]), words)
        return f"words {found[0]!r} became {found[1]!r}"
    for before, after in zip(NUMBER.findall(committed), NUMBER.findall(executed), strict=True):
        # A number that was rounded may differ by one in its last digit.
        decimals = len(before.partition("e")[0].partition(".")[2])
        last_digit = 10.0**-decimals if "e" not in before else 0.0
        if not math.isclose(
            float(before), float(after), rel_tol=RELATIVE_TOLERANCE, abs_tol=1.01 * last_digit
        ):
            return f"{before} became {after}"
    return None


def differences(committed: Path, executed: Path) -> list[str]:
    """Return what differs between two versions of a notebook, a sentence each."""
    cells = [
        [
            cell
            for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]
            if "outputs" in cell
        ]
        for path in (committed, executed)
    ]
    found = []
    for number, (old, new) in enumerate(zip(*cells, strict=True), 1):
        (old_kinds, old_text), (new_kinds, new_text) = outputs_of(old), outputs_of(new)
        reason = None
        if old_kinds != new_kinds:
            reason = f"outputs {old_kinds} became {new_kinds}"
        elif "varies" not in old["metadata"].get("tags", []):
            reason = difference(old_text, new_text)
        if reason is not None:
            found.append(f"{committed.name}, code cell {number}: {reason}")
    return found


def main() -> None:
    """Compare notebooks, print what differs, and end with exit code 1 if anything does."""
    executed, *committed = map(Path, sys.argv[1:])
    found = [line for path in committed for line in differences(path, executed / path.name)]
    sys.stdout.write("\n".join(found or ["the notebooks give what is committed"]) + "\n")
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
