"""Calibrate many robots: in worker processes, and with what robots of one type have in common."""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
