"""Joint calibration of cameras on robot arms, differentiable from the arm to the pixel.

Conventions, kept by every function and file:

- a transform `target_from_source` maps points of `source` into `target`;
- metres, radians, pixels; the centre of the top-left pixel is (0, 0);
- the camera looks along +z, x to the right, y down;
- tangents of rigid transforms are translation first, then rotation;
- float64: importing this package turns on JAX's x64 mode, because calibration is
  ill-conditioned in single precision.
"""

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as _version

import jax as _jax

_jax.config.update("jax_enable_x64", True)

from .calibration import Calibration as Calibration  # noqa: E402
from .dataset import Dataset as Dataset  # noqa: E402

try:
    __version__ = _version("smartview-jax")
except PackageNotFoundError:  # a checkout that was never installed
    __version__ = "0+unknown"
