"""Measure how good a calibration is: reprojection errors, held-out errors, comparisons of methods.

Errors on given views are computed here. Errors on views that no fit used are in `held_out`, the
uncertainty of a result is in `uncertainty`, and the causes of an error are in `diagnosis`.
"""

from ..fit_result import Rejection as Rejection
from .diagnosis import ErrorBudget as ErrorBudget
from .diagnosis import Explanation as Explanation
from .diagnosis import Repeatability as Repeatability
from .diagnosis import error_budget as error_budget
from .diagnosis import explanations as explanations
from .diagnosis import lens_misfit as lens_misfit
from .diagnosis import region_error as region_error
from .diagnosis import repeatability as repeatability
from .free_poses import free_pose_deviations as free_pose_deviations
from .held_out import UNCORRECTED as UNCORRECTED
from .held_out import Foretold as Foretold
from .held_out import HeldOut as HeldOut
from .held_out import Interval as Interval
from .held_out import Method as Method
from .held_out import Refit as Refit
from .held_out import Row as Row
from .held_out import Unseen as Unseen
from .held_out import compare as compare
from .held_out import foretold as foretold
from .held_out import has_correction as has_correction
from .held_out import held_out as held_out
from .held_out import predicted_deviations as predicted_deviations
from .held_out import refit as refit
from .held_out import region_folds as region_folds
from .held_out import rms_interval as rms_interval
from .held_out import score as score
from .held_out import split_views as split_views
from .held_out import standard_methods as standard_methods
from .held_out import unseen_errors as unseen_errors
from .held_out import view_folds as view_folds
from .held_out import without_correction as without_correction
from .measures import Deviations as Deviations
from .measures import Predictor as Predictor
from .measures import deviations as deviations
from .rejections import RejectionCount as RejectionCount
from .rejections import count_rejected as count_rejected
from .rejections import rejected_by as rejected_by
from .rejections import without_rejected_views as without_rejected_views
from .stylus import stylus_miss as stylus_miss
from .stylus import touching as touching
from .uncertainty import Bound as Bound
from .uncertainty import Estimate as Estimate
from .uncertainty import Measured as Measured
from .uncertainty import covariance_of as covariance_of
from .uncertainty import coverage as coverage
from .uncertainty import covered as covered
from .uncertainty import cramer_rao as cramer_rao
from .uncertainty import mean_nees as mean_nees
from .uncertainty import nees as nees
from .uncertainty import std_of as std_of
