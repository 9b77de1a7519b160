"""How good a calibration is: deviations, held-out error, methods side by side."""

from .compare import Method as Method
from .compare import Row as Row
from .compare import compare as compare
from .compare import standard_methods as standard_methods
from .cramer_rao import Bound as Bound
from .cramer_rao import cramer_rao as cramer_rao
from .free_poses import free_pose_deviations as free_pose_deviations
from .held_out import HeldOut as HeldOut
from .held_out import Refit as Refit
from .held_out import held_out as held_out
from .held_out import refit as refit
from .held_out import score as score
from .held_out import view_folds as view_folds
from .measures import Deviations as Deviations
from .measures import Predictor as Predictor
from .measures import deviations as deviations
from .rejections import Rejection as Rejection
from .rejections import RejectionCount as RejectionCount
from .rejections import count_rejected as count_rejected
from .rejections import rejected_by as rejected_by
from .uncertainty import Estimate as Estimate
from .uncertainty import covariance_of as covariance_of
from .uncertainty import std_of as std_of
