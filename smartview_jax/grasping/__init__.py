"""Plan grasps of found objects: robot commands, their checks, and the probability of success."""

from ..robots import Gripper as Gripper
from .candidates import suggested_grasps as suggested_grasps
from .localized import LocalizedObject as LocalizedObject
from .localized import PlacedObject as PlacedObject
from .planned import PHASES as PHASES
from .planned import GraspPlan as GraspPlan
from .planned import NoSafeGraspError as NoSafeGraspError
from .planned import PlannedGrasp as PlannedGrasp
from .planning import Motion as Motion
from .planning import grasps_for as grasps_for
from .scene import GraspScene as GraspScene
from .scene import Obstacle as Obstacle
from .stylus_touches import MissComparison as MissComparison
from .stylus_touches import compare_misses as compare_misses
from .stylus_touches import ellipse_axes as ellipse_axes
from .stylus_touches import stylus_orientations as stylus_orientations
from .stylus_touches import tip_error_factor as tip_error_factor
from .success import Conditions as Conditions
from .success import success_probability as success_probability
from .tool_commands import TOOL_CHECKS as TOOL_CHECKS
from .tool_commands import ToolCommands as ToolCommands
from .tool_commands import gripper_commands as gripper_commands
from .tool_commands import tool_commands as tool_commands
from .touch_correction import correct_by_touches as correct_by_touches
from .uncertainty import camera_covariance as camera_covariance
