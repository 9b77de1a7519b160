"""Use depth sensors: points of a target measured in three dimensions, and the target's poses."""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
