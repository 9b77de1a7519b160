"""Rigid transforms, angle conventions, pose formats, camera viewpoints and images of circles."""

from ..deprecation import deprecated_names as _deprecated_names
from .camera_poses import FIVE_VIEWPOINT_PATTERNS as FIVE_VIEWPOINT_PATTERNS
from .camera_poses import FIVE_VIEWPOINT_STEP as FIVE_VIEWPOINT_STEP
from .camera_poses import five_viewpoints as five_viewpoints
from .camera_poses import look_at as look_at
from .camera_poses import viewing_direction as viewing_direction
from .conics import circle_dual_conic as circle_dual_conic
from .conics import conic_centre as conic_centre
from .conics import region_centroid as region_centroid
from .euler import rotation_from_ypr as rotation_from_ypr
from .euler import ypr_from_rotation as ypr_from_rotation
from .host import host_adjoints as host_adjoints
from .host import host_cross_matrices as host_cross_matrices
from .host import host_exponentials as host_exponentials
from .host import host_logarithms as host_logarithms
from .host import host_matrices as host_matrices
from .host import host_transforms as host_transforms
from .oat import oat_from_rotation as oat_from_rotation
from .oat import rotation_from_oat as rotation_from_oat
from .oat import se3_from_xyzoat as se3_from_xyzoat
from .oat import xyzoat as xyzoat
from .pose_codecs import ANGLE_UNITS as ANGLE_UNITS
from .pose_codecs import LENGTH_UNITS as LENGTH_UNITS
from .pose_codecs import POSE_CODECS as POSE_CODECS
from .pose_codecs import PoseCodec as PoseCodec
from .pose_codecs import pose_codec as pose_codec
from .rigid_transforms import PoseLike as PoseLike
from .rigid_transforms import as_se3 as as_se3
from .rigid_transforms import check_rigid as check_rigid
from .rigid_transforms import host_nearest_rotation as host_nearest_rotation
from .rigid_transforms import mean_matrix as mean_matrix
from .rigid_transforms import mean_pose as mean_pose
from .rigid_transforms import nearest_rotation as nearest_rotation
from .rigid_transforms import rotation_angle as rotation_angle
from .rigid_transforms import se3_left_jacobian as se3_left_jacobian
from .rigid_transforms import transform_points as transform_points
from .rigid_transforms import transformed_coordinates as transformed_coordinates
from .serialization import transform_from_dict as transform_from_dict
from .serialization import transform_to_dict as transform_to_dict
from .transform_text import transform_text as transform_text
from .viewed_region import ViewedRegion as ViewedRegion
from .viewed_region import region_from_dict as region_from_dict
from .viewed_region import region_to_dict as region_to_dict

__getattr__ = _deprecated_names(__name__)
