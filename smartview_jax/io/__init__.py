"""Data sets and calibrations on disk: folders, importers, exporters."""

from .dataset_folder import save_dataset as save_dataset
from .export import opencv_coefficients as opencv_coefficients
from .export import opencv_yaml as opencv_yaml
from .export import ros_camera_info as ros_camera_info
from .export import ros_static_transform as ros_static_transform
from .export import urdf_origin as urdf_origin
from .foreign import read_matrix_rows as read_matrix_rows
from .foreign import read_opencv_camera as read_opencv_camera
from .foreign import read_visp_camera as read_visp_camera
from .foreign import read_visp_pose as read_visp_pose
from .load import load_dataset as load_dataset
from .pairs import import_pairs as import_pairs
from .robot_cal_tools import import_robot_cal_tools as import_robot_cal_tools
from .sample import sample_folder as sample_folder
