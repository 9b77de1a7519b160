"""Solve `A X = X B` for the hand-eye and world transforms: Step 3 of the paper's pipeline.

Closed forms (`closed_form.py`) give starts, `solution.py` minimises the paper's Frobenius cost
(`frobenius.py`, Eq. 17) from the best of them, and `minimum_norm.py` leaves undetermined directions
where they were.
"""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
