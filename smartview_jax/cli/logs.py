"""Show on the terminal what the library logs, and keep off it what other libraries say.

The library's loggers are named by its modules, `smartview_jax.joint.fit` and so on. Importing it
configures nothing; a program that uses it decides by itself, as the command does here.
"""

import logging
import os
from collections.abc import Callable

LOGGER = "smartview_jax"
"""The name of the logger above all of the library's."""

NOISY_LOGGERS = ("absl", "jax", "jax._src.xla_bridge", "matplotlib", "trimesh")
"""Loggers of other libraries whose remarks a person at a robot can do nothing about."""

NOISY_VARIABLES = {"OPENCV_LOG_LEVEL": "SILENT", "TF_CPP_MIN_LOG_LEVEL": "2"}
"""The variables that libraries written in C++ read when loaded, with values that quieten them."""

_FORMAT = "%(relativeCreated)6.0f ms  %(name)s: %(message)s"


def configure_logs(verbosity: int) -> Callable[[], None]:
    """Let the library's loggers write to stderr, and quieten those of other libraries.

    Args:
        verbosity: 0 for warnings alone, 1 for what is done, 2 for everything, also of others.

    Returns:
        A function that gives all loggers their former levels again, for a program that goes on
        after the command.
    """
    logger = logging.getLogger(LOGGER)
    quietened = [logging.getLogger(name) for name in (NOISY_LOGGERS if verbosity < 2 else ())]
    former_levels = [(one, one.level) for one in (logger, *quietened)]
    _remove_handlers(logger)
    if verbosity:
        handler = _ToStderr()
        handler.setFormatter(logging.Formatter(_FORMAT))
        logger.addHandler(handler)
    # A level of its own: the root logger belongs to the program, not to a library.
    logger.setLevel({0: logging.WARNING, 1: logging.INFO}.get(verbosity, logging.DEBUG))
    for one in quietened:
        one.setLevel(logging.ERROR)
    if verbosity < 2:
        for name, value in NOISY_VARIABLES.items():
            # What a person has set stays: they want to see it.
            os.environ.setdefault(name, value)

    def restore() -> None:
        """Give all loggers their former levels, and remove the command's own handler."""
        _remove_handlers(logger)
        for one, level in former_levels:
            one.setLevel(level)

    return restore


def _remove_handlers(logger: logging.Logger) -> None:
    """Remove the handlers of this command, one of which there is at most after each call."""
    for handler in [one for one in logger.handlers if isinstance(one, _ToStderr)]:
        logger.removeHandler(handler)


class _ToStderr(logging.StreamHandler):
    """A handler of this command, told from those that a program has put there."""
