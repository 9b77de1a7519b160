"""Measure how good a calibration is: reprojection errors, held-out errors, comparisons of methods.

Errors on given views are computed here. Errors on views that no fit used are in `held_out`, the
uncertainty of a result is in `uncertainty`, and the causes of an error are in `diagnosis`.
"""

from ..fit_result import Rejection as Rejection
from .diagnosis import ErrorBudget as ErrorBudget
from .diagnosis import ScaleHypothesis as ScaleHypothesis
from .diagnosis import SplitHalfDifference as SplitHalfDifference
from .diagnosis import error_budget as error_budget
from .diagnosis import lens_misfit as lens_misfit
from .diagnosis import region_held_out_rms as region_held_out_rms
from .diagnosis import scale_hypotheses as scale_hypotheses
from .diagnosis import split_half_difference as split_half_difference
from .free_poses import free_pose_errors as free_pose_errors
from .held_out import MIN_HELD_OUT_VIEWS as MIN_HELD_OUT_VIEWS
from .held_out import UNCORRECTED_SUFFIX as UNCORRECTED_SUFFIX
from .held_out import FoldFit as FoldFit
from .held_out import HeldOutErrors as HeldOutErrors
from .held_out import HeldOutPoses as HeldOutPoses
from .held_out import HeldOutReport as HeldOutReport
from .held_out import Interval as Interval
from .held_out import Method as Method
from .held_out import MethodResult as MethodResult
from .held_out import PredictedError as PredictedError
from .held_out import choose_uncorrected as choose_uncorrected
from .held_out import compare as compare
from .held_out import expected_reprojection_errors as expected_reprojection_errors
from .held_out import fit_folds as fit_folds
from .held_out import has_correction as has_correction
from .held_out import held_out as held_out
from .held_out import held_out_poses as held_out_poses
from .held_out import held_out_reports as held_out_reports
from .held_out import predicted_error as predicted_error
from .held_out import region_folds as region_folds
from .held_out import rms_interval as rms_interval
from .held_out import score as score
from .held_out import split_views as split_views
from .held_out import standard_methods as standard_methods
from .held_out import view_folds as view_folds
from .measures import Predictor as Predictor
from .measures import ReprojectionErrors as ReprojectionErrors
from .measures import reprojection_errors as reprojection_errors
from .measures import root_mean_square as root_mean_square
from .rejections import RejectionCount as RejectionCount
from .rejections import count_rejected as count_rejected
from .rejections import rejected_by as rejected_by
from .rejections import without_rejected_rig_views as without_rejected_rig_views
from .rejections import without_rejected_views as without_rejected_views
from .stylus import stylus_error as stylus_error
from .stylus import touching_pose as touching_pose
from .uncertainty import CalibrationEstimate as CalibrationEstimate
from .uncertainty import ConsistencyStatistic as ConsistencyStatistic
from .uncertainty import CramerRaoBound as CramerRaoBound
from .uncertainty import PictureUncertainty as PictureUncertainty
from .uncertainty import RigBound as RigBound
from .uncertainty import WorkspaceUncertainty as WorkspaceUncertainty
from .uncertainty import covariance_of as covariance_of
from .uncertainty import covariance_root as covariance_root
from .uncertainty import coverage as coverage
from .uncertainty import cramer_rao as cramer_rao
from .uncertainty import mean_nees as mean_nees
from .uncertainty import nees as nees
from .uncertainty import picture_uncertainty as picture_uncertainty
from .uncertainty import std_of as std_of
from .uncertainty import within_interval as within_interval
from .uncertainty import workspace_uncertainty as workspace_uncertainty
