"""The outcome of a fit: whether it converged, and which points and views it left out."""

from enum import StrEnum
from typing import NamedTuple


class FitCode(StrEnum):
    """The outcome of a fit as one word."""

    CONVERGED = "converged"
    STOPPED_EARLY = "stopped_early"
    DIVERGED = "diverged"


class FitResult(NamedTuple):
    """The outcome of a fit as a code and a message.

    A fit that failed does not raise by itself; call `require_convergence` to raise.

    Attributes:
        code: the outcome as one word.
        message: what happened, and what may help.
    """

    code: FitCode
    message: str

    @property
    def converged(self) -> bool:
        """Whether the result is the optimum."""
        return self.code is FitCode.CONVERGED

    def require_convergence(self) -> None:
        """Raise unless the fit converged.

        Raises:
            RuntimeError: the fit did not converge; with the code and the message.
        """
        if not self.converged:
            raise RuntimeError(f"{self.code}: {self.message}")


class Rejection(NamedTuple):
    """A point, or a whole view, that a fit did not use.

    Attributes:
        view: identifier of the view.
        point: index of the point; None for the whole view.
        reason: why it was left out.
    """

    view: str
    point: int | None
    reason: str
