"""Calibrate in the paper's three steps, as the baseline and as the start of the joint fit.

    Step 1  each view by itself, Weng's two-step method       weng*.py (Eq. 8)
    Step 2  one camera for all views, iterated Kalman filter  kalman*.py (Eq. 9)
    Step 3  hand-eye and world transforms, `A X = X B`        the room hand_eye (Eq. 17)

`fit.py` runs the three, with the checks of the room data_checks between them; `picture_steps.py`
holds what it needs of the pictures alone. `two_poses.py` lets the robot choose between the two
poses of a small flat target; `start_checks.py` checks a given start; `few_views.py` places a camera
by a target whose place is known; `two_hands.py` places the bases of two arms, one with the camera
and one with the target; `interpolation.py` is the comparison method of the paper's Table 1.
"""

from ..data_checks import ConventionHypothesis as ConventionHypothesis
from ..data_checks import ConventionReport as ConventionReport
from ..data_checks import ViewConsistency as ViewConsistency
from ..data_checks import check_conventions as check_conventions
from ..data_checks import closure_error as closure_error
from ..data_checks import find_consistent_views as find_consistent_views
from ..data_checks import median_reprojection_errors as median_reprojection_errors
from ..data_checks import mistaken_unit as mistaken_unit
from ..data_checks import relative_motions as relative_motions
from ..data_checks import views_to_use as views_to_use
from ..hand_eye import CLOSED_FORMS as CLOSED_FORMS
from ..hand_eye import HandEyeResult as HandEyeResult
from ..hand_eye import daniilidis as daniilidis
from ..hand_eye import park_martin as park_martin
from ..hand_eye import shah as shah
from ..hand_eye import solve_hand_eye as solve_hand_eye
from ..hand_eye import tsai_lenz as tsai_lenz
from .few_views import FewViewsStart as FewViewsStart
from .few_views import start_by_target as start_by_target
from .fit import MAX_UNCHECKED_POINTS as MAX_UNCHECKED_POINTS
from .fit import fit_one_view_intrinsics as fit_one_view_intrinsics
from .fit import fit_staged as fit_staged
from .given_start import check_start as check_start
from .given_start import known_transforms as known_transforms
from .given_start import merged_start as merged_start
from .given_start import require_picture_size as require_picture_size
from .interpolation import Interpolation as Interpolation
from .kalman import KalmanResult as KalmanResult
from .kalman import kalman_filter as kalman_filter
from .kalman import outlier_limits as outlier_limits
from .kalman import pixel_residuals as pixel_residuals
from .kalman import robust_sigma as robust_sigma
from .staged_fit import CommonCameraOptions as CommonCameraOptions
from .staged_fit import StagedFit as StagedFit
from .staged_fit import with_region as with_region
from .start_checks import start_doubts as start_doubts
from .start_checks import with_start_doubts as with_start_doubts
from .weng import ViewCalibrations as ViewCalibrations
from .weng import calibrate_views as calibrate_views
from .weng import estimate_view_poses as estimate_view_poses
