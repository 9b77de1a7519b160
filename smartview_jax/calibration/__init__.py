"""Provide calibrations: camera, hand-eye and world transforms, which predict and command."""

from .calibration import Calibration as Calibration
from .file_content import FORMAT_VERSION as FORMAT_VERSION
from .mount import host_mount_from_holder as host_mount_from_holder
from .mount import mount_frames as mount_frames
from .mount import mount_from_holder as mount_from_holder
from .mount import transform_names as transform_names
from .target_shape import BOW as BOW
from .target_shape import PRINT as PRINT
from .target_shape import SHAPE_NAMES as SHAPE_NAMES
from .target_shape import TargetShape as TargetShape
from .target_shape import flat_shape as flat_shape
