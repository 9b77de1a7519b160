"""Provide robot arms and grippers: kinematics both ways, joint limits, and robot commands."""

from ..deprecation import deprecated_names as _deprecated_names
from .command import MAX_TOOL_COORDINATE as MAX_TOOL_COORDINATE
from .command import Command as Command
from .command import CommandLike as CommandLike
from .command import JointsLike as JointsLike
from .command import as_command as as_command
from .general_inverse_kinematics import joints_for_pose as joints_for_pose
from .gripper import BOX_CORNERS as BOX_CORNERS
from .gripper import BOX_TRIANGLES as BOX_TRIANGLES
from .gripper import Gripper as Gripper
from .gripper import GripperBox as GripperBox
from .iterative_inverse_kinematics import solve_joints_iteratively as solve_joints_iteratively
from .joint_axes import arm_from_axes as arm_from_axes
from .joint_solution import FAILURE_FLAGS as FAILURE_FLAGS
from .joint_solution import LIMIT_TOLERANCE as LIMIT_TOLERANCE
from .joint_solution import JointSolution as JointSolution
from .joint_solution import SolutionStatus as SolutionStatus
from .models import ARMS as ARMS
from .models import arm_by_name as arm_by_name
from .models import kuka_lwr4 as kuka_lwr4
from .models import puma_560 as puma_560
from .models import puma_560_lee as puma_560_lee
from .models import six_axes as six_axes
from .puma_inverse_kinematics import branch_joints as branch_joints
from .puma_inverse_kinematics import is_puma_like as is_puma_like
from .puma_inverse_kinematics import nearest_puma_joints as nearest_puma_joints
from .puma_inverse_kinematics import puma_joints as puma_joints
from .serial_arm import SerialArm as SerialArm
from .serial_arm import dh_jacobian as dh_jacobian
from .serialization import arm_from_dict as arm_from_dict
from .serialization import arm_to_dict as arm_to_dict
from .trajectory import Trajectory as Trajectory

__getattr__ = _deprecated_names(__name__)
