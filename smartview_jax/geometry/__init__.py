"""Rigid transforms, angle conventions and pose formats."""

from .euler import rotation_from_ypr as rotation_from_ypr
from .euler import ypr_from_rotation as ypr_from_rotation
from .oat import oat_from_rotation as oat_from_rotation
from .oat import rotation_from_oat as rotation_from_oat
from .oat import se3_from_xyzoat as se3_from_xyzoat
from .oat import xyzoat as xyzoat
from .plain import transform_from_dict as transform_from_dict
from .plain import transform_to_dict as transform_to_dict
from .pose_codecs import ANGLE_UNITS as ANGLE_UNITS
from .pose_codecs import LENGTH_UNITS as LENGTH_UNITS
from .pose_codecs import POSE_CODECS as POSE_CODECS
from .pose_codecs import PoseCodec as PoseCodec
from .pose_codecs import pose_codec as pose_codec
from .rigid import PoseLike as PoseLike
from .rigid import as_se3 as as_se3
from .rigid import check_rigid as check_rigid
from .rigid import exp_jacobian as exp_jacobian
from .rigid import mean_pose as mean_pose
from .rigid import nearest_rotation as nearest_rotation
from .rigid import rotation_angle as rotation_angle
from .rigid import transform_points as transform_points
from .viewing import FIVE_STEP as FIVE_STEP
from .viewing import direction_of as direction_of
from .viewing import five_viewpoints as five_viewpoints
from .viewing import look_at as look_at
