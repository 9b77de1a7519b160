"""Measure how good a calibration is: reprojection errors, held-out errors, comparisons of methods.

Errors on given views are computed here. Errors on views that no fit used are in `held_out`, the
uncertainty of a result is in `uncertainty`, and the causes of an error are in `diagnosis`.
"""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
