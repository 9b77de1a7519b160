"""Calibrate in the paper's three steps, as the baseline and as the start of the joint fit.

    Step 1  each view by itself, Weng's two-step method       weng*.py (Eq. 8)
    Step 2  one camera for all views, iterated Kalman filter  kalman*.py (Eq. 9)
    Step 3  hand-eye and world transforms, `A X = X B`        hand_eye.py, frobenius.py (Eq. 17),
                                                              closed_form.py, minimum_norm.py

`fit.py` runs the three. `two_poses.py` lets the robot choose between the two poses of a small flat
target; `questions.py` says in which order the data are checked between the steps
(`target_checks.py`, `camera_checks.py`, `conventions.py`, `view_consistency.py`), and
`start_checks.py` checks a given start; `interpolation.py` is the comparison method of the paper's
Table 1.
"""

from .closed_form import CLOSED_FORMS as CLOSED_FORMS
from .closed_form import daniilidis as daniilidis
from .closed_form import park_martin as park_martin
from .closed_form import shah as shah
from .closed_form import tsai_lenz as tsai_lenz
from .closure import closure_error as closure_error
from .closure import relative_motions as relative_motions
from .conventions import ConventionHypothesis as ConventionHypothesis
from .conventions import ConventionReport as ConventionReport
from .conventions import check_conventions as check_conventions
from .conventions import mistaken_unit as mistaken_unit
from .fit import MAX_UNCHECKED_POINTS as MAX_UNCHECKED_POINTS
from .fit import StagedFit as StagedFit
from .fit import fit_one_view_intrinsics as fit_one_view_intrinsics
from .fit import fit_staged as fit_staged
from .fit import views_to_use as views_to_use
from .frobenius import frobenius_cost as frobenius_cost
from .given_start import check_start as check_start
from .given_start import merged_start as merged_start
from .given_start import require_picture_size as require_picture_size
from .given_start import start_without as start_without
from .hand_eye import HandEyeResult as HandEyeResult
from .hand_eye import solve_hand_eye as solve_hand_eye
from .interpolation import Interpolation as Interpolation
from .kalman import KalmanResult as KalmanResult
from .kalman import kalman_filter as kalman_filter
from .kalman import pixel_residuals as pixel_residuals
from .kalman import robust_sigma as robust_sigma
from .region import with_region as with_region
from .start_checks import start_doubts as start_doubts
from .view_consistency import ViewConsistency as ViewConsistency
from .view_consistency import find_consistent_views as find_consistent_views
from .view_consistency import median_reprojection_errors as median_reprojection_errors
from .weng import ViewCalibrations as ViewCalibrations
from .weng import calibrate_views as calibrate_views
from .weng import estimate_view_poses as estimate_view_poses
