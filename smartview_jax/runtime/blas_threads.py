"""Run the linear algebra of many small matrices on one thread.

OpenBLAS distributes even products of small matrices over all cores, and its threads wait for each
other without pause: on two cores, one used by another process, the search for the standard
deviations of errors then takes twice as long.
"""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

_P = ParamSpec("_P")
_R = TypeVar("_R")


def on_one_blas_thread(function: Callable[_P, _R]) -> Callable[_P, _R]:
    """Return the function, with the BLAS libraries of this process on one thread while it runs."""

    @functools.wraps(function)
    def call(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with _controller().limit(limits=1, user_api="blas"):
            return function(*args, **kwargs)

    return call


@functools.cache
def _controller():
    """Return the controller of the thread pools of the libraries that are loaded."""
    # Imported here: it looks through all loaded libraries, including SciPy's.
    import scipy.linalg  # noqa: F401
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()
