"""Describe calibration targets by their points in metres, without using OpenCV."""

from .april_grid import AprilGrid as AprilGrid
from .charuco import Charuco as Charuco
from .chessboard import Chessboard as Chessboard
from .circle_grid import CircleGrid as CircleGrid
from .listed_points import ListedPoints as ListedPoints
from .serialization import target_from_dict as target_from_dict
from .serialization import target_to_dict as target_to_dict
from .stacked import StackedTarget as StackedTarget
from .tag_grid import TagGrid as TagGrid
from .target import AbstractTarget as AbstractTarget
from .target import grid_symmetries as grid_symmetries
