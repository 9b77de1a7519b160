"""Refuse meshes in text form that a reader would misread in part.

trimesh reads what it finds: a number that a blank has broken in two is another vertex, and of a PLY
only as many lines are read as its header says.
"""

from pathlib import Path


def refuse_broken_text(path: Path, kind: str) -> None:
    """Raise a ValueError if a mesh in text form has rows too many or too few, or of other lengths.

    Args:
        path: of the file.
        kind: its format; files of other formats than OBJ and PLY pass.
    """
    if kind == "obj":
        _check_obj(path)
    elif kind == "ply":
        _check_ply(path)


def _check_obj(path: Path) -> None:
    """Raise a ValueError if some vertices have more numbers than others.

    Three are a point; a fourth, which is a weight, and three more for a colour are legal.
    """
    rows = (line.split() for line in path.read_bytes().splitlines())
    counts = {len(row) - 1 for row in rows if row and row[0] == b"v"}
    if len(counts) > 1:
        numbers = ", ".join(map(str, sorted(counts)))
        raise ValueError(f"{path}: vertices of {numbers} numbers; expected as many in each")


def _check_ply(path: Path) -> None:
    """Raise a ValueError if the rows of a PLY in text form do not match its header."""
    header, mark, rest = path.read_bytes().partition(b"end_header")
    if not mark or b"format ascii" not in header:
        return
    rows = [row for line in rest.splitlines() if (row := line.split())]
    # By element: the number of rows, and the kinds of values in each.
    elements: list[tuple[int, list[bool]]] = []
    for words in (line.split() for line in header.splitlines()):
        if words[:1] == [b"element"] and len(words) == 3 and words[2].isdigit():
            elements.append((int(words[2]), []))
        elif words[:1] == [b"property"] and elements:
            elements[-1][1].append(words[1:2] == [b"list"])
    expected = sum(count for count, _ in elements)
    if len(rows) != expected:
        raise ValueError(f"{path}: {len(rows)} rows, but its header says {expected}")
    start = 0
    for count, is_list in elements:
        for row in rows[start : start + count]:
            if len(row) != _row_length(row, is_list):
                text = b" ".join(row[:8]).decode("latin-1")
                raise ValueError(f"{path}: the row {text!r} has not the numbers of its header")
        start += count


def _row_length(row: list[bytes], is_list: list[bool]) -> int:
    """Return how many words a row has, in which each list begins with its length."""
    place = 0
    for one in is_list:
        if not one:
            place += 1
        elif place < len(row) and row[place].isdigit():
            place += 1 + int(row[place])
        else:
            return -1
    return place
