"""Rigid transforms, angle conventions and pose formats."""

from .rigid import PoseLike as PoseLike
from .rigid import as_se3 as as_se3
from .rigid import check_rigid as check_rigid
from .rigid import concatenate as concatenate
from .rigid import rotation_angle as rotation_angle
