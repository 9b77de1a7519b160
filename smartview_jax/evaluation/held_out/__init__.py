"""Cross-validate: estimate errors on views that no fit used, for one method or several."""

from .bootstrap import Interval as Interval
from .bootstrap import rms_interval as rms_interval
from .compare import UNCORRECTED_SUFFIX as UNCORRECTED_SUFFIX
from .compare import Method as Method
from .compare import MethodResult as MethodResult
from .compare import compare as compare
from .compare import standard_methods as standard_methods
from .folds import region_folds as region_folds
from .folds import split_views as split_views
from .folds import view_folds as view_folds
from .held_out import FoldFit as FoldFit
from .held_out import HeldOutErrors as HeldOutErrors
from .held_out import choose_uncorrected as choose_uncorrected
from .held_out import fit_folds as fit_folds
from .held_out import has_correction as has_correction
from .held_out import held_out as held_out
from .held_out import predictor_of as predictor_of
from .held_out import score as score
from .held_out_report import HeldOutReport as HeldOutReport
from .held_out_report import held_out_reports as held_out_reports
from .predicted_error import PredictedError as PredictedError
from .predicted_error import expected_reprojection_errors as expected_reprojection_errors
from .predicted_error import expected_squared_errors as expected_squared_errors
from .predicted_error import predicted_error as predicted_error
from .tracked_poses import HeldOutPoses as HeldOutPoses
from .tracked_poses import held_out_poses as held_out_poses
