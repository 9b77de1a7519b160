"""Calibrate in the paper's three steps, as the baseline and as the start of the joint fit.

    Step 1  each view by itself, Weng's two-step method       weng*.py (Eq. 8)
    Step 2  one camera for all views, iterated Kalman filter  kalman*.py (Eq. 9)
    Step 3  hand-eye and world transforms, `A X = X B`        the room hand_eye (Eq. 17)

`fit.py` runs the three: Steps 1 and 2 in `common_camera.py`, by the parts in `picture_steps.py`,
and the checks of the room data_checks before Step 3 in `motion_checks.py`; `picture_parts.py` fits
two cameras where pictures of some views may have been resized. `two_poses.py` lets the
robot choose between the two poses of a small flat target; `start_checks.py` checks a given start;
`few_views.py` places a camera by a target whose place is known; `two_hands.py` places the bases of
two arms, one with the camera and one with the target; `interpolation.py` is the comparison method
of the paper's Table 1.
"""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
