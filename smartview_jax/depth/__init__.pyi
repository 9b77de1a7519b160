from .depth_pictures import cloud_from_depth as cloud_from_depth
from .depth_pictures import points_at_pixels as points_at_pixels
from .depth_pictures import read_depth_picture as read_depth_picture
from .measured_poses import MeasuredPoses as MeasuredPoses
from .measured_poses import poses_from_points as poses_from_points
