"""Print and write the result of `smartview calibrate`, or pass it on to programs."""

import abc
import secrets
import shlex
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import smartview_jax as sv

from ..files import file_transaction


def run_name() -> str:
    """Return a unique name for a run, written to all its files: the time and a random part."""
    return f"{datetime.now(UTC):%Y-%m-%dT%H:%M:%SZ}-{secrets.token_hex(3)}"


class AbstractResult(abc.ABC):
    """A fit, and what was computed about it.

    Attributes:
        notes: remarks on the data, and on what could not be computed.
        given: the options that state prior knowledge, in words.
    """

    name: str
    fit: Any
    notes: tuple[str, ...]
    given: str = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """The reasons to doubt the result."""
        return self.fit.warnings

    @property
    def converged(self) -> bool:
        """Whether the joint fit converged."""
        return self.fit.result.converged

    @property
    def remarks(self) -> tuple[str, ...]:
        """Notes and warnings as lines for people."""
        return (*self.notes, *(f"warning: {text}" for text in self.warnings))

    @property
    def source(self) -> str:
        """The data, and values that were given: where the numbers of a file come from."""
        return f"{self.name}; given: {self.given}" if self.given else self.name

    def origin(self, run: str) -> "sv.report.Origin":
        """Return the data set and the command, as the report states them."""
        command_line = shlex.join(["smartview", *sys.argv[1:]])
        return sv.report.Origin(self.name, command_line, run, self.given)

    @abc.abstractmethod
    def print(self) -> None:
        """Print the result with its uncertainty, its errors and its warnings."""

    def write(self, out: Path, run: str, progress: Callable[[str], None]) -> dict[Path, str]:
        """Write all files of a run, or none, and return what each file is."""
        texts = self.file_descriptions
        # All files appear together, so that the report always belongs to the calibration.
        with file_transaction(out, tuple(texts)) as folder:
            self.write_files(folder, run, progress)
        return {out / name: text for name, text in texts.items() if (out / name).is_file()}

    @property
    @abc.abstractmethod
    def file_descriptions(self) -> dict[str, str]:
        """The description of each file that may be written, by file name."""

    @abc.abstractmethod
    def write_files(self, folder: Path, run: str, progress: Callable[[str], None]) -> None:
        """Write the files into an existing folder."""

    def document(self, run: str, files: list[Path]) -> dict[str, Any]:
        """Return everything that was computed, as values for programs."""
        return {
            **self.entries(run),
            "notes": list(self.notes),
            "warnings": list(self.warnings),
            "files": files,
        }

    @abc.abstractmethod
    def entries(self, run: str) -> dict[str, Any]:
        """Return the entries of `document` that depend on what was calibrated."""
