"""Have JAX compute in double precision (64 bits), and refuse to compute in single precision.

Calibration is ill-conditioned in single precision: fits fail, or end elsewhere, and their messages
blame the data. The mode is therefore on before the package, or its user, makes the first array.
Importing the package does not import JAX, which takes a second that `smartview --help` does not
owe. Where JAX is not imported yet, the environment variable that it reads then is set. Programs
that are started from this process inherit it, as they inherit what a user sets.

What a user turns off later is not turned on again, because other code of the process may need it;
every program of the package, and every conversion of numbers to arrays of JAX, says so instead.
"""

import os
import sys

VARIABLE = "JAX_ENABLE_X64"
"""The environment variable that JAX reads when it is imported."""


def enable_double_precision() -> None:
    """Turn on JAX's 64-bit mode, now if JAX is already imported and else for when it is."""
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)
    else:
        os.environ[VARIABLE] = "1"


def require_double_precision() -> None:
    """Raise an error if JAX computes in single precision here.

    Raises:
        RuntimeError: the 64-bit mode was turned off after the package was imported.
    """
    # The package alone is imported without JAX; whoever asks has imported it.
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "JAX computes in single precision here, in which a calibration fails or goes astray: "
            "its 64-bit mode was turned off after smartview_jax was imported. Call "
            'jax.config.update("jax_enable_x64", True) before the data are read, or leave the '
            "context jax.enable_x64(False); arrays made until then are to be made again"
        )
