"""Find known objects in calibrated pictures: hypotheses, verification and the next view."""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
