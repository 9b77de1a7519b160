"""Plan grasps of found objects: the robot's commands, their checks, their chance of success."""

from ..robots import Gripper as Gripper
from .candidates import suggested_grasps as suggested_grasps
from .commands import gripper_commands as gripper_commands
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
from .success import Conditions as Conditions
from .success import success_probability as success_probability
