"""Import optional packages, with an error that states how to install a missing one."""

import importlib
from typing import Any


class MissingExtraError(ImportError):
    """An optional package that is not installed; the message states what to install."""


def import_extra(module: str, extra: str, purpose: str) -> Any:
    """Return a module of an optional package.

    Args:
        module: its name, dotted.
        extra: the extra of this package that installs it.
        purpose: what needs it, for the message.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        package = module.partition(".")[0].replace("_", "-")
        raise MissingExtraError(
            f"{purpose} needs {package}: pip install 'smartview-jax[{extra}]'"
        ) from error
