"""Plan viewpoints: wanted camera poses, the robot commands for them, and the best next views."""

from ..deprecation import deprecated_names as _deprecated_names
from ..geometry import FIVE_VIEWPOINT_STEP as FIVE_VIEWPOINT_STEP
from ..geometry import five_viewpoints as five_viewpoints
from ..geometry import look_at as look_at
from ..geometry import viewing_direction as viewing_direction
from .candidate_selection import cumulative_criterion as cumulative_criterion
from .candidate_selection import views_needed as views_needed
from .checks import CHECK_MESSAGES as CHECK_MESSAGES
from .checks import SAFETY_CHECKS as SAFETY_CHECKS
from .checks import Checks as Checks
from .checks import ClearancePlane as ClearancePlane
from .checks import Limits as Limits
from .commands import ViewCalibration as ViewCalibration
from .commands import ViewpointCommands as ViewpointCommands
from .commands import predict as predict
from .commands import viewpoint_commands as viewpoint_commands
from .information_model import InformationModel as InformationModel
from .next_views import TYPICAL_NOISE as TYPICAL_NOISE
from .next_views import ViewPlan as ViewPlan
from .next_views import first_view_distances as first_view_distances
from .next_views import model_from_estimate as model_from_estimate
from .next_views import plan_views as plan_views
from .next_views import with_assumed_region as with_assumed_region
from .optimality_criteria import OptimalityCriterion as OptimalityCriterion
from .optimality_criteria import a_optimal as a_optimal
from .optimality_criteria import d_optimal as d_optimal
from .optimality_criteria import i_optimal as i_optimal
from .view_planning import ChosenViews as ChosenViews
from .view_planning import choose_views as choose_views
from .view_range import ViewRange as ViewRange

__getattr__ = _deprecated_names(__name__)
