"""Check data before and between the steps of a calibration, and name what is wrong with them.

`questions.py` says in which order: the poses (`usable_views.py`), the detections
(`target_checks.py`), the camera by itself (`camera_checks.py`), then whether robot and camera move
alike (`conventions.py`, with the usual mistakes in `mistakes.py`, `misread_angles.py`,
`length_units.py` and `joint_mistakes.py`, judged by `rotation_angles.py` and by the closure of
motions, `closure.py`) and
tell a wrong mount at all (`inverted_poses.py`), whether the set-up changed between two views
(`changes.py`) or drifts (`set_up_drift.py`, beyond the errors of `smooth_errors.py`), the poses lag
(`pose_lag.py`, by the fit in `lag_fit.py`) or the views agree in groups (`view_groups.py`;
`faults_of_many_views.py` asks all four, in the words of `change_texts.py`), and which single views
are numbered wrongly (`shifted_numbering.py`) or contradict the others (`view_consistency.py`); all
judge by transforms of their own (`transform_fit.py`), some by transforms of the views that agree
(`largest_group.py`) or by the odds of an explanation (`misfit_evidence.py`). `rig_checks.py`
compares the cameras of a rig.
"""

from .camera_checks import CameraDoubt as CameraDoubt
from .camera_checks import camera_misfit as camera_misfit
from .camera_checks import camera_problem as camera_problem
from .changes import ChangeOptions as ChangeOptions
from .changes import ChangeReport as ChangeReport
from .changes import find_change as find_change
from .closure import closure_error as closure_error
from .closure import relative_motions as relative_motions
from .convention_hypotheses import ConventionHypothesis as ConventionHypothesis
from .conventions import ConventionReport as ConventionReport
from .conventions import check_conventions as check_conventions
from .faults_of_many_views import RobotAndCamera as RobotAndCamera
from .faults_of_many_views import SharedFault as SharedFault
from .faults_of_many_views import find_shared_fault as find_shared_fault
from .focus_changes import SeenDistances as SeenDistances
from .given_poses import target_turns as target_turns
from .joint_mistakes import OTHER_ARM_RATIO as OTHER_ARM_RATIO
from .joint_mistakes import OTHER_ARM_TEXT as OTHER_ARM_TEXT
from .joint_mistakes import joint_problem as joint_problem
from .length_units import mistaken_unit as mistaken_unit
from .other_arm import find_other_arm as find_other_arm
from .pose_lag import PoseLag as PoseLag
from .pose_lag import find_lag as find_lag
from .questions import Findings as Findings
from .questions import detection_findings as detection_findings
from .questions import pose_findings as pose_findings
from .rig_checks import SeenTarget as SeenTarget
from .rig_checks import TargetFindings as TargetFindings
from .rig_checks import target_findings as target_findings
from .set_up_drift import DriftOptions as DriftOptions
from .set_up_drift import SetUpDrift as SetUpDrift
from .set_up_drift import find_drift as find_drift
from .shifted_numbering import find_shifted_numbering as find_shifted_numbering
from .shifted_numbering import shift_text as shift_text
from .target_checks import collinear_views as collinear_views
from .target_checks import mismatched_views as mismatched_views
from .usable_views import MINIMUM_POINTS as MINIMUM_POINTS
from .usable_views import mask_unusable_views as mask_unusable_views
from .usable_views import minimum_points as minimum_points
from .usable_views import require_minimum_views as require_minimum_views
from .usable_views import unusable_views as unusable_views
from .usable_views import views_to_use as views_to_use
from .view_consistency import MAX_MISFIT_RATIO as MAX_MISFIT_RATIO
from .view_consistency import MAX_REJECTED_FRACTION as MAX_REJECTED_FRACTION
from .view_consistency import ViewConsistency as ViewConsistency
from .view_consistency import find_consistent_views as find_consistent_views
from .view_consistency import median_reprojection_errors as median_reprojection_errors
from .view_consistency import stale_views as stale_views
from .view_groups import GroupOptions as GroupOptions
from .view_groups import find_groups as find_groups
