"""Model the difference between reported and true robot poses: robot error fields and priors."""

from .arm_errors import AbstractArmErrors as AbstractArmErrors
from .arm_errors import DHErrors as DHErrors
from .arm_errors import JointOffsets as JointOffsets
from .arm_errors import JointRatios as JointRatios
from .arm_errors import nominal_arm as nominal_arm
from .combined import CombinedField as CombinedField
from .field import AbstractField as AbstractField
from .field import AbstractLinearField as AbstractLinearField
from .field import AbstractPreparedField as AbstractPreparedField
from .field import FieldChoice as FieldChoice
from .field import checked_field_choice as checked_field_choice
from .generic_six_axis_arm import GenericSixAxisArm as GenericSixAxisArm
from .linear_fields import LinearInPose as LinearInPose
from .linear_fields import LinearInPosition as LinearInPosition
from .robot_error import RobotError as RobotError
from .robot_prior import RobotPrior as RobotPrior
from .scale_error import LinearInPoseWithScales as LinearInPoseWithScales
from .scale_error import ScaleError as ScaleError
from .serialization import field_by_name as field_by_name
from .serialization import field_name as field_name
from .serialization import robot_error_from_dict as robot_error_from_dict
from .serialization import robot_error_to_dict as robot_error_to_dict
