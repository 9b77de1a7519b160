"""Describe calibration targets by their points in metres, without using OpenCV."""

from .boards import AprilGrid as AprilGrid
from .boards import Charuco as Charuco
from .boards import Chessboard as Chessboard
from .boards import CircleGrid as CircleGrid
from .boards import TagGrid as TagGrid
from .listed_points import ListedPoints as ListedPoints
from .marker_dictionaries import MARKER_COUNTS as MARKER_COUNTS
from .serialization import target_from_dict as target_from_dict
from .serialization import target_to_dict as target_to_dict
from .stacked import StackedTarget as StackedTarget
from .target import AbstractTarget as AbstractTarget
from .target import grid_symmetries as grid_symmetries
