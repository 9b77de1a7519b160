"""How a fit ended, and what it left out."""

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


class Rejection(NamedTuple):
    """One point, or one whole view, that a fit did not use.

    Attributes:
        view: its id.
        point: index of the point; None for the whole view.
        reason: why.
    """

    view: str
    point: int | None
    reason: str
