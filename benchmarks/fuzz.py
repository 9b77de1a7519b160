"""Malformed files: every one is refused by an error that names it, or holds values in their range.

python -m benchmarks.fuzz --count 10000 --seed 7 runs a campaign of its own.
"""

import argparse
import collections
import copy
import random
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from .fuzz_formats import FORMATS, Format

COUNT = 10_000
"""Mutations of a full campaign, over all formats."""

SMOKE_COUNT = 300

NASTY: tuple[Any, ...] = (
    None,
    True,
    False,
    0,
    -1,
    1,
    0.5,
    -0.5,
    7,
    1e-300,
    1e6,
    1e300,
    -1e300,
    float("nan"),
    float("inf"),
    -float("inf"),
    10**30,
    "",
    " ",
    "a",
    "1",
    "0x10",
    "1e999",
    "nan",
    "\u0660",
    "a\u0000b",
    "../..",
    "{",
    "{0}",
    "{view.__class__}",
    "*" * 300,
    [],
    {},
    [[]],
    [None],
    [1, 2],
    [float("nan")] * 3,
    {"a": 1},
    {1: 2},
    {"model": {}},
    ["a"] * 1000,
)
"""Values that stand where they should not."""

TOKENS = (
    *"nan -inf 1e999 -1 0 1_0 \u0661 0x1f 1e-3 010 1:30 true null ~ '' \"\" * &a *a !!int".split(),
    *(
        "!!bool x",
        "!!timestamp x",
        "!!python/none",
        "!!binary x",
        "!!set x",
        "<<: 1",
        "? [1]",
        "- ",
    ),
    *("[" * 300, "{" * 300, "9" * 5000, "1" * 400, "," * 50, '"', "\x00", "\ufeff", "\r", "\x85"),
    *("&a [*a]", "2024-13-45", "1" * 30 + ":30.5", "\ud7ff", "%", "#", "---", "...", "\t"),
)
"""Text that stands where it should not."""


class Finding(NamedTuple):
    """What went wrong with a malformed file.

    Attributes:
        format: of the file.
        words: the error, or which value was accepted.
        content: of the file.
    """

    format: str
    words: str
    content: bytes


def mutated(content: bytes, rng: random.Random) -> bytes:
    """Return a file's content with one to three mistakes in it."""
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        content = rng.choice((_other_bytes, _other_lines, _other_words, _other_tree))(content, rng)
    return content


def _other_bytes(content: bytes, rng: random.Random) -> bytes:
    place = rng.randrange(len(content) + 1)
    junk = rng.choice((b"\x00", b"\xff", b"\xc3", b"\xed\xa0\x80", b"\r", b"\xef\xbb\xbf", b"\n"))
    ways = (
        content[:place],
        content[place:],
        content[:place] + junk + content[place:],
        content[:place] + bytes([rng.randrange(256)]) + content[place + 1 :],
        content[:place] + content[place + rng.randrange(1, 9) :],
        content.decode("utf-8", "replace").encode("utf-16"),
    )
    return rng.choice(ways[:5] if rng.random() < 0.95 else ways)


def _other_lines(content: bytes, rng: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    if not lines:
        return content
    k, j = rng.randrange(len(lines)), rng.randrange(len(lines))
    way = rng.randrange(4)
    if way == 0:
        lines.insert(j, lines[k])
    elif way == 1:
        del lines[k]
    elif way == 2:
        lines[k], lines[j] = lines[j], lines[k]
    else:
        lines[k] = b"  " + lines[k]
    return b"".join(lines)


def _other_words(content: bytes, rng: random.Random) -> bytes:
    """Put something else in the place of a number or a word."""
    text = content.decode("utf-8", "replace")
    ends = [k for k, letter in enumerate(text) if letter in " ,:[]{}\n<>=\"'"]
    if len(ends) < 2:
        return content
    k = rng.randrange(len(ends) - 1)
    word = rng.choice(TOKENS)
    return (text[: ends[k] + 1] + word + text[ends[k + 1] :]).encode("utf-8", "replace")


def _other_tree(content: bytes, rng: random.Random) -> bytes:
    """Change an entry of a YAML file; other files get another word."""
    try:
        tree = yaml.safe_load(content)
    except Exception:
        tree = None
    if not isinstance(tree, dict | list) or not tree:
        return _other_words(content, rng)
    tree = copy.deepcopy(tree)
    node: Any = tree
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        key = rng.choice(keys)
        inner = node[key]
        if not isinstance(inner, dict | list) or not inner or rng.random() < 0.15:
            break
        node = inner
    way = rng.randrange(5)
    if way == 0:
        del node[key]
    elif way == 1 and isinstance(node, dict):
        node[rng.choice((f"{key}x", str(key)[:-1], 7, "end", "model"))] = node[key]
    elif way == 2 and isinstance(node, list):
        node.append(rng.choice(NASTY))
    else:
        node[key] = rng.choice(NASTY)
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True).encode("utf-8", "replace")


def campaign(
    folder: Path, count: int, seed: int, say: Callable[[str], None] = lambda _: None
) -> list[Finding]:
    """Read so many malformed files, and return what went wrong.

    Args:
        folder: an empty one, to work in.
        count: of files, over all formats.
        seed: of the mutations.
        say: told how each format fared.
    """
    rng = random.Random(seed)
    findings: list[Finding] = []
    for name, kind in FORMATS.items():
        place = folder / name
        place.mkdir()
        path = kind.write(place)
        whole, outcomes = path.read_bytes(), collections.Counter[str]()
        kind.refuse_out_of_range(kind.read(path))
        started = time.monotonic()
        for _ in range(-(-count // len(FORMATS))):
            path.write_bytes(mutated(whole, rng))
            outcome = _outcome(kind, path)
            outcomes[outcome if outcome in ("refused", "accepted") else "wrong"] += 1
            if outcome not in ("refused", "accepted"):
                findings.append(Finding(name, outcome, path.read_bytes()))
        say(f"  {name:26}{dict(outcomes)}, {time.monotonic() - started:.1f} s")
    return findings


def _outcome(kind: Format, path: Path) -> str:
    try:
        found = kind.read(path)
    except (ValueError, FileNotFoundError) as error:
        named = str(path.parent) in str(error)
        plain = type(error) in (ValueError, FileNotFoundError)
        return "refused" if named and plain else f"unnamed {type(error).__name__}: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    try:
        kind.refuse_out_of_range(found)
    except AssertionError as error:
        return f"out of range: {error}"
    return "accepted"


def run(smoke: bool = False, count: int | None = None, seed: int = 1) -> bool:
    """Print how each format fared; True where nothing went wrong."""
    count = count or (SMOKE_COUNT if smoke else COUNT)
    with tempfile.TemporaryDirectory() as folder:
        findings = campaign(Path(folder), count, seed, print)
    for finding in findings[:20]:
        print(f"{finding.format}: {finding.words[:300]}\n    {finding.content[:300]!r}")
    print(f"{count} malformed files, seed {seed}: {len(findings)} went wrong")
    return not findings


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz")
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    sys.exit(not run(count=arguments.count, seed=arguments.seed))
