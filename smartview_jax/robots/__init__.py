"""Arms: how a robot's reported pose differs from where its tool is."""

from .fields import AbstractField as AbstractField
from .fields import LinearInPose as LinearInPose
from .fields import LinearInPosition as LinearInPosition
from .fields import field_by_name as field_by_name
from .fields import field_name as field_name
from .robot_error import RobotError as RobotError
