"""Provide robot arms: forward and inverse kinematics, joint limits, and robot commands."""

from ..moved import moved as _moved
from .axes import arm_from_axes as arm_from_axes
from .command import FARTHEST as FARTHEST
from .command import Command as Command
from .command import CommandLike as CommandLike
from .command import JointsLike as JointsLike
from .command import as_command as as_command
from .inverse_kinematics import joints_near as joints_near
from .joint_solution import NO_ANSWER as NO_ANSWER
from .joint_solution import SLACK as SLACK
from .joint_solution import JointSolution as JointSolution
from .joint_solution import Status as Status
from .models import ARMS as ARMS
from .models import arm_by_name as arm_by_name
from .models import kuka_lwr4 as kuka_lwr4
from .models import puma_560 as puma_560
from .models import puma_560_lee as puma_560_lee
from .models import six_axes as six_axes
from .puma_inverse import branch_joints as branch_joints
from .puma_inverse import is_puma_like as is_puma_like
from .puma_inverse import nearest_puma_joints as nearest_puma_joints
from .puma_inverse import puma_joints as puma_joints
from .serial_arm import SerialArm as SerialArm
from .serial_arm import by_numbers as by_numbers
from .serialization import arm_from_dict as arm_from_dict
from .serialization import arm_to_dict as arm_to_dict
from .solve_joints import joints_for_pose as joints_for_pose

# The error fields below live in `robot_errors`, which imports this package. A lookup by text finds
# them under their old names without a circular import.
__getattr__ = _moved(
    __name__,
    dict.fromkeys(
        """
        AbstractField AbstractLinearField CombinedField DHErrors ImpliedArm JointOffsets JointRatios
        LinearInPose LinearInPosition PoseOrStretch RobotError RobotPrior Stretched arm_of
        field_by_name field_name robot_error_from_dict robot_error_to_dict
        """.split(),
        "smartview_jax.robot_errors",
    ),
)
