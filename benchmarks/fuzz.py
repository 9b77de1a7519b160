"""Malformed files: every one is refused by an error that names it, or holds values in their range.

Each file is a good one with one to three mistakes in it, of kinds that have names. Mistakes that
only spell a number otherwise, or take a part of the file away, must not change a value that is
accepted: a file that is read all the same has the values of the good one.

python -m benchmarks.fuzz --count 10000 --seed 7 runs a campaign of its own.
"""

import argparse
import collections
import contextlib
import dataclasses
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .fuzz_formats import FORMATS, Format
from .fuzz_text import Mutation, together

COUNT = 10_000
"""Malformed files of a full campaign, over all formats."""

SMOKE_COUNT = 300

NUMBERS_OF_MISTAKES = (1, 1, 1, 2, 3)
"""How many mistakes a file has, each as often as it is here: one shows best what it does."""

FINDINGS_SHOWN = 40
"""Findings that are printed."""

SAME_VALUE = 1e-6
"""Largest relative difference of a value that counts as the same: meshes have single precision."""


MAX_SECONDS = 5.0
"""Longest processor time for one file, s: all good ones take some milliseconds."""


class _TooSlowError(BaseException):
    """A file takes too long; no handler of the package may take it for an error of the file."""


class Finding(NamedTuple):
    """What went wrong with a malformed file.

    Attributes:
        format: of the file.
        kinds: of its mistakes.
        words: the error, or which value was accepted.
        content: of the file.
    """

    format: str
    kinds: tuple[str, ...]
    words: str
    content: bytes


class Tally:
    """How files fared, by format and by the kind of the mistake.

    Attributes:
        by_format, by_kind: numbers of files that were refused, accepted, or went wrong.
        findings: what went wrong.
    """

    def __init__(self) -> None:
        self.by_format: dict[str, collections.Counter[str]] = {}
        self.by_kind: dict[str, collections.Counter[str]] = {}
        self.findings: list[Finding] = []

    def add(self, name: str, kinds: Sequence[str], outcome: str, content: bytes) -> None:
        """Count a file; what is neither refused nor accepted is a finding."""
        word = outcome if outcome in ("refused", "accepted") else "wrong"
        self.by_format.setdefault(name, collections.Counter())[word] += 1
        for kind in dict.fromkeys(kinds):
            self.by_kind.setdefault(kind, collections.Counter())[word] += 1
        if word == "wrong":
            self.findings.append(Finding(name, tuple(kinds), outcome, content))

    def table(self) -> Iterator[str]:
        """Return lines of a table by kind, with the formats in which something went wrong."""
        yield f"  {'kind of mistake':32}{'files':>8}{'refused':>9}{'accepted':>9}{'wrong':>7}"
        for kind, counts in self.by_kind.items():
            where = collections.Counter(f.format for f in self.findings if kind in f.kinds)
            formats = ", ".join(f"{name} ({count})" for name, count in where.items())
            numbers = (counts.total(), counts["refused"], counts["accepted"], counts["wrong"])
            yield f"  {kind:32}" + "{:8}{:9}{:9}{:7}".format(*numbers) + f"  {formats}".rstrip()


def mutated(
    content: bytes, rng: random.Random, mutations: Mapping[str, Mutation], first: str
) -> tuple[bytes, tuple[str, ...]]:
    """Return a file's content with one to three mistakes in it, and their kinds.

    Args:
        content: of a good file.
        rng: draws the mistakes.
        mutations: the kinds of mistakes.
        first: the kind of the first mistake; another one is taken where the file has no place for
            it.
    """
    kinds: list[str] = []
    wanted, kind = rng.choice(NUMBERS_OF_MISTAKES), first
    while len(kinds) < wanted:
        changed = mutations[kind].change(content, rng)
        if changed is not None:
            content = changed
            kinds.append(kind)
        kind = rng.choice(list(mutations))
    return content, tuple(kinds)


def campaign(
    folder: Path, count: int, seed: int, say: Callable[[str], None] = lambda _: None
) -> Tally:
    """Read so many malformed files, and return what went wrong.

    Args:
        folder: an empty one, to work in.
        count: of files, over all formats.
        seed: of the mistakes.
        say: told how each format fared.
    """
    tally = Tally()
    paths: dict[str, Path] = {}
    for name, kind in FORMATS.items():
        place = folder / name
        place.mkdir()
        paths[name] = kind.write(place)
    others = together([path.read_bytes() for path in paths.values()])
    for name, kind in FORMATS.items():
        # Each format has draws of its own, so that another format changes none of them.
        rng, path = random.Random(f"{seed} {name}"), paths[name]
        mutations = {**kind.mutations, **others}
        whole, found = path.read_bytes(), kind.read(path)
        kind.refuse_out_of_range(found)
        expected, waiting, started = values_of(found), list[str](), time.process_time()
        for _ in range(-(-count // len(FORMATS))):
            # Every kind once, before any comes again.
            waiting = waiting or rng.sample(list(mutations), len(mutations))
            content, kinds = mutated(whole, rng, mutations, waiting.pop())
            path.write_bytes(content)
            keeps = all(mutations[one].keeps_values for one in kinds)
            tally.add(name, kinds, _outcome(kind, path, expected if keeps else None), content)
        seconds = time.process_time() - started
        say(f"  {name:26}{dict(tally.by_format[name])}, {seconds:.1f} s of processor time")
    return tally


def _outcome(kind: Format, path: Path, expected: Sequence[np.ndarray] | None) -> str:
    """Return how a file fared.

    Args:
        kind: of the file.
        path: of the file.
        expected: the values that it must have if it is accepted; None where they may be others.
    """
    try:
        with _time_limit():
            found = kind.read(path)
    except _TooSlowError as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        return f"more than {MAX_SECONDS:g} s, in {where.name}"
    except (ValueError, FileNotFoundError) as error:
        named = str(path.parent) in str(error)
        plain = type(error) in (ValueError, FileNotFoundError)
        return "refused" if named and plain else f"unnamed {type(error).__name__}: {error}"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    try:
        kind.refuse_out_of_range(found)
        if expected is not None:
            refuse_other_values(values_of(found), expected)
    except AssertionError as error:
        return f"out of range: {error}"
    return "accepted"


@contextlib.contextmanager
def _time_limit() -> Iterator[None]:
    """Raise an error in code that needs more processor time than a file may take."""

    def stop(*_: Any) -> None:
        raise _TooSlowError

    before = signal.signal(signal.SIGPROF, stop)
    # Again and again: an error within a finalizer or a callback of C code is lost.
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS, 0.1)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, before)


def values_of(found: Any) -> list[np.ndarray]:
    """Return all numbers that were read, in a fixed order; names are left out."""
    if dataclasses.is_dataclass(found):
        parts = [getattr(found, field.name) for field in dataclasses.fields(found)]
    elif isinstance(found, Mapping):
        parts = [part for key, value in found.items() for part in (key, value)]
    elif isinstance(found, tuple | list):
        parts = list(found)
    else:
        array = np.asarray(found)
        return [np.ravel(array).astype(float)] if array.dtype.kind in "biuf" else []
    return [array for part in parts for array in values_of(part)]


def refuse_other_values(found: Sequence[np.ndarray], expected: Sequence[np.ndarray]) -> None:
    """Raise an AssertionError for values that differ from the good file's."""
    sizes, wanted = [part.size for part in found], [part.size for part in expected]
    assert sizes == wanted, f"{sum(sizes)} numbers; the good file has {sum(wanted)}"
    for part, good in zip(found, expected, strict=True):
        assert np.allclose(part, good, SAME_VALUE, SAME_VALUE * SAME_VALUE, equal_nan=True), (
            f"another value than in the good file: {part[:6]} for {good[:6]}"
        )


def run(smoke: bool = False, count: int | None = None, seed: int = 1) -> bool:
    """Print how each format and each kind fared; True where nothing went wrong."""
    count = count or (SMOKE_COUNT if smoke else COUNT)
    with tempfile.TemporaryDirectory() as folder:
        tally = campaign(Path(folder), count, seed, print)
    print("\n".join(tally.table()))
    for finding in tally.findings[:FINDINGS_SHOWN]:
        kinds = ", ".join(finding.kinds)
        print(f"{finding.format} ({kinds}): {finding.words[:300]}\n    {finding.content[:300]!r}")
    print(f"{count} malformed files, seed {seed}: {len(tally.findings)} went wrong")
    return not tally.findings


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fuzz")
    parser.add_argument("--count", type=int, default=COUNT)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    sys.exit(not run(count=arguments.count, seed=arguments.seed))
