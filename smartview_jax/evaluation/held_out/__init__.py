"""Estimate errors on views that no fit used, for one method or several side by side."""

from .bootstrap import Interval as Interval
from .bootstrap import rms_interval as rms_interval
from .compare import UNCORRECTED as UNCORRECTED
from .compare import Method as Method
from .compare import Row as Row
from .compare import compare as compare
from .compare import standard_methods as standard_methods
from .folds import region_folds as region_folds
from .folds import split_views as split_views
from .folds import view_folds as view_folds
from .held_out import HeldOut as HeldOut
from .held_out import Refit as Refit
from .held_out import has_correction as has_correction
from .held_out import held_out as held_out
from .held_out import predictor_of as predictor_of
from .held_out import refit as refit
from .held_out import score as score
from .held_out import without_correction as without_correction
from .predicted import Foretold as Foretold
from .predicted import expected_squares as expected_squares
from .predicted import foretold as foretold
from .predicted import predicted_deviations as predicted_deviations
from .unseen import Unseen as Unseen
from .unseen import unseen_errors as unseen_errors
