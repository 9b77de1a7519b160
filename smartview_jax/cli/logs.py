"""Show the library's log on the terminal, and quieten other libraries.

The library's loggers are named by its modules, `smartview_jax.joint.fit` and so on. Importing the
library configures no logging: that is left to the program, such as the command here.
"""

import logging
import os
from collections.abc import Callable

LOGGER = "smartview_jax"
"""The name of the library's top logger."""

NOISY_LOGGERS = ("absl", "jax", "jax._src.xla_bridge", "matplotlib", "trimesh")
"""Loggers of other libraries whose remarks do not help a person at a robot."""

NOISY_VARIABLES = {"OPENCV_LOG_LEVEL": "SILENT", "TF_CPP_MIN_LOG_LEVEL": "2"}
"""Environment variables that quieten libraries in C++, which read them when loaded."""

_FORMAT = "%(relativeCreated)6.0f ms  %(name)s: %(message)s"


def configure_logs(verbosity: int) -> Callable[[], None]:
    """Let the library's loggers write to stderr, and quieten other libraries.

    Verbosity is 0 for warnings alone, 1 for progress, 2 for everything, with other libraries. The
    returned function restores the levels, for a program that goes on after the command.
    """
    logger = logging.getLogger(LOGGER)
    quietened = [logging.getLogger(name) for name in (NOISY_LOGGERS if verbosity < 2 else ())]
    former_levels = [(changed, changed.level) for changed in (logger, *quietened)]
    _remove_handlers(logger)
    if verbosity:
        handler = _ToStderr()
        handler.setFormatter(logging.Formatter(_FORMAT))
        logger.addHandler(handler)
    # The root logger is left alone: it belongs to the program.
    logger.setLevel({0: logging.WARNING, 1: logging.INFO}.get(verbosity, logging.DEBUG))
    for noisy_logger in quietened:
        noisy_logger.setLevel(logging.ERROR)
    if verbosity < 2:
        for name, value in NOISY_VARIABLES.items():
            # A value that the user has set stays.
            os.environ.setdefault(name, value)

    def restore() -> None:
        """Restore the levels of all loggers, and remove the command's own handler."""
        _remove_handlers(logger)
        for changed, level in former_levels:
            changed.setLevel(level)

    return restore


def _remove_handlers(logger: logging.Logger) -> None:
    """Remove this command's handlers from a logger."""
    for handler in [item for item in logger.handlers if isinstance(item, _ToStderr)]:
        logger.removeHandler(handler)


class _ToStderr(logging.StreamHandler):
    """The handler of this command; its class tells it from a program's own handlers."""
