"""Names in backticks in docstrings and comments exist: the API reference has no dead ends."""

import builtins
import io
import re
import tokenize
from functools import cache
from pathlib import Path

from test_layers import FILES as ROOM_FILES
from test_layers import PACKAGE

FILES = [PACKAGE / "__init__.py", *ROOM_FILES]

ELSEWHERE = set(
    """
    cornerSubPix FileStorage calibration_type lwr_description
""".split()
)
"""Names of other libraries and formats, which docstrings speak of."""


@cache
def names_of(file: Path) -> tuple[set[str], list[str]]:
    """The identifiers and the texts in quotes of a file, and its docstrings and comments."""
    names, texts = set(), []
    for token in tokenize.generate_tokens(io.StringIO(file.read_text("utf-8")).readline):
        if token.type == tokenize.NAME:
            names.add(token.string)
        elif token.type == tokenize.COMMENT or token.string.lstrip("rf").startswith('"""'):
            texts.append(token.string)
        elif token.type == tokenize.STRING:
            names |= set(re.findall(r"[A-Za-z_]\w*", token.string))
    return names, texts


@cache
def known() -> set[str]:
    inside = set().union(*(names_of(file)[0] for file in FILES))
    modules = {part for file in FILES for part in (file.stem, file.parent.name)}
    return inside | modules | set(dir(builtins)) | ELSEWHERE


def references(text: str) -> set[str]:
    """The identifiers in backticks that can only be names: with an underscore, or in CamelCase.

    A single letter before or after an underscore is a symbol of a formula, as in `t_camera`.
    """
    found = {
        name
        for quoted in re.findall(r"`([^`\n]+)`", text)
        for name in re.findall(r"(?<![\w'\"/.-])[A-Za-z_]\w*(?:\.[A-Za-z_]\w*)*", quoted)
    }
    parts = {part for name in found for part in name.split(".")}
    return {
        part
        for part in parts
        if re.search(r"[a-z0-9]{2}_[a-z]{2}|[a-z][A-Z]|[A-Z]{2}_[A-Z]{2}", part)
    }


def test_what_is_referred_to_exists():
    missing = {
        str(file.relative_to(PACKAGE)): names
        for file in FILES
        if (names := set().union(*map(references, names_of(file)[1]), set()) - known())
    }
    assert not missing


def test_a_dead_reference_is_found():
    assert references("see `Dataset.no_such_name` and `a + b`") == {"no_such_name"}
    assert "no_such_name" not in known()
