"""Turn on JAX's 64-bit mode, also where JAX is imported later than this package.

Importing the package does not import JAX, which takes a second that `smartview --help` does not
owe. The mode must nevertheless be on before a user, or any part of the package, makes the first
array; single precision would otherwise pass unnoticed. The environment variable JAX_ENABLE_X64
would do that too, but all programs that are started from this process would inherit it.
"""

import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType


def enable_double_precision() -> None:
    """Turn on JAX's 64-bit mode, now if JAX is already imported and else when it is."""
    if "jax" in sys.modules:
        _enable(sys.modules["jax"])
    else:
        sys.meta_path.insert(0, _JaxFinder())


def _enable(jax: ModuleType) -> None:
    """Turn on the 64-bit mode of the imported JAX."""
    jax.config.update("jax_enable_x64", True)


class _JaxFinder:
    """A finder that finds JAX alone, once, and has the 64-bit mode turned on after its import."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the specification of JAX; None for every other module."""
        if fullname != "jax":
            return None
        # Without this finder, the search below returns what an ordinary import would.
        sys.meta_path.remove(self)
        spec = find_spec(fullname)
        if spec is None or spec.loader is None:
            return spec
        run_module = spec.loader.exec_module

        def run_and_enable(module: ModuleType) -> None:
            """Run JAX's own code, and then turn on its 64-bit mode."""
            run_module(module)
            _enable(module)

        spec.loader.exec_module = run_and_enable
        return spec
