"""Run the linear algebra of many small matrices on one thread.

OpenBLAS distributes even products of small matrices over all cores, and its threads wait for each
other without pause: on two cores, one used by another process, the search for the standard
deviations of errors then takes twice as long.
"""

import functools
from collections.abc import Callable
from contextvars import ContextVar
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")

_is_limited: ContextVar[bool] = ContextVar("_is_limited", default=False)
"""Whether a function of this thread has set the limit already."""


def on_one_blas_thread(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function, with the BLAS libraries of this process on one thread while it runs."""

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        if _is_limited.get():
            return function(*args, **kwargs)
        token = _is_limited.set(True)
        try:
            with _controller().limit(limits=1, user_api="blas"):
                return function(*args, **kwargs)
        finally:
            _is_limited.reset(token)

    return call


@functools.cache
def _controller():
    """Return the controller of the thread pools of the libraries that are loaded."""
    # Imported here: it looks through all loaded libraries, including SciPy's.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
