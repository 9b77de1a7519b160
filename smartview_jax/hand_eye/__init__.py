"""Solve `A X = X B` for the hand-eye and world transforms: Step 3 of the paper's pipeline.

Closed forms (`closed_form.py`) give starts, `solution.py` minimises the paper's Frobenius cost
(`frobenius.py`, Eq. 17) from the best of them, and `minimum_norm.py` leaves undetermined directions
where they were.
"""

from .closed_form import CLOSED_FORMS as CLOSED_FORMS
from .closed_form import daniilidis as daniilidis
from .closed_form import mean_camera_from_mount as mean_camera_from_mount
from .closed_form import mean_holder_from_world as mean_holder_from_world
from .closed_form import motion_pairs as motion_pairs
from .closed_form import park_martin as park_martin
from .closed_form import shah as shah
from .closed_form import tsai_lenz as tsai_lenz
from .minimum_norm import determined_steps as determined_steps
from .minimum_norm import minimum_norm_transforms as minimum_norm_transforms
from .solution import HandEyeResult as HandEyeResult
from .solution import solve_hand_eye as solve_hand_eye
