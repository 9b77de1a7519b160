"""Provide calibrations: camera, hand-eye and world transforms, which predict and command."""

from .calibration import Calibration as Calibration
from .chain import BASES as BASES
from .chain import ONE_ARM_MOUNTS as ONE_ARM_MOUNTS
from .chain import chain_transform_names as chain_transform_names
from .chain import host_mount_from_holder as host_mount_from_holder
from .chain import mount_frames as mount_frames
from .chain import mount_from_holder as mount_from_holder
from .chain import mount_from_holder_matrices as mount_from_holder_matrices
from .chain import transform_names as transform_names
from .depth_bias import DepthBias as DepthBias
from .file_content import FORMAT_VERSION as FORMAT_VERSION
from .target_shape import BOW as BOW
from .target_shape import PRINT as PRINT
from .target_shape import SHAPE_NAMES as SHAPE_NAMES
from .target_shape import TargetShape as TargetShape
from .target_shape import flat_shape as flat_shape
