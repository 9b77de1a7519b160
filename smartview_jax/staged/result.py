"""How a fit ended."""

from enum import StrEnum
from typing import NamedTuple


class FitCode(StrEnum):
    """In one word."""

    CONVERGED = "converged"
    STOPPED_EARLY = "stopped_early"
    DIVERGED = "diverged"


class FitResult(NamedTuple):
    """How a fit ended, and in words what happened and what may help.

    A fit that failed never raises by itself; `require` does, for who wants it to.
    """

    code: FitCode
    message: str

    @property
    def converged(self) -> bool:
        """Whether the answer is the optimum."""
        return self.code is FitCode.CONVERGED

    def require(self) -> None:
        """Raise unless the fit converged.

        Raises:
            RuntimeError: with the message.
        """
        if not self.converged:
            raise RuntimeError(f"{self.code}: {self.message}")
