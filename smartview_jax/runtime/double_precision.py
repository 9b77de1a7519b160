"""Make JAX compute in double precision (64 bits), and refuse to compute in single precision.

Calibration is ill-conditioned in single precision: fits fail or end at a wrong result, and their
messages blame the data. The 64-bit mode is therefore turned on before the first array is made.
Importing the package does not import JAX, which takes a second that `smartview --help` should not
spend. If JAX is not imported yet, the environment variable that it reads on import is set instead.
Programs started from this process inherit the variable.

If a user turns the mode off later, it stays off, because other code of the process may need that.
Every program of the package and every conversion of numbers to JAX arrays then raises an error.
"""

import os
import sys

VARIABLE = "JAX_ENABLE_X64"
"""The environment variable that JAX reads when it is imported."""


def enable_double_precision() -> None:
    """Turn on JAX's 64-bit mode: now if JAX is already imported, otherwise when it is imported."""
    if "jax" in sys.modules:
        sys.modules["jax"].config.update("jax_enable_x64", True)
    else:
        os.environ[VARIABLE] = "1"


def require_double_precision() -> None:
    """Raise an error if JAX computes in single precision here.

    Raises:
        RuntimeError: the 64-bit mode was turned off after the package was imported.
    """
    # Callers have imported JAX already; importing the package alone does not.
    import jax

    if not jax.config.read("jax_enable_x64"):
        raise RuntimeError(
            "JAX computes in single precision here, where a calibration fails or goes astray: "
            "its 64-bit mode was turned off after smartview_jax was imported. Call "
            'jax.config.update("jax_enable_x64", True) before the data are read, or leave the '
            "context jax.enable_x64(False); arrays made in single precision must be made again"
        )
