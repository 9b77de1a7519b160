"""Arms: forward kinematics, and how what a robot reports differs from where its tool is."""

from .arm_errors import DHErrors as DHErrors
from .arm_errors import JointOffsets as JointOffsets
from .command import Command as Command
from .command import CommandLike as CommandLike
from .command import JointsLike as JointsLike
from .command import as_command as as_command
from .field import AbstractField as AbstractField
from .field import AbstractLinearField as AbstractLinearField
from .inverse_kinematics import joints_near as joints_near
from .linear_fields import LinearInPose as LinearInPose
from .linear_fields import LinearInPosition as LinearInPosition
from .models import ARMS as ARMS
from .models import arm_by_name as arm_by_name
from .models import kuka_lwr4 as kuka_lwr4
from .models import six_axes as six_axes
from .names import field_by_name as field_by_name
from .names import field_name as field_name
from .plain import arm_from_dict as arm_from_dict
from .plain import arm_to_dict as arm_to_dict
from .plain import robot_error_from_dict as robot_error_from_dict
from .plain import robot_error_to_dict as robot_error_to_dict
from .robot_error import RobotError as RobotError
from .serial_arm import SerialArm as SerialArm
from .stretch import PoseOrStretch as PoseOrStretch
