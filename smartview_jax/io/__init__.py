"""Data sets and calibrations on disk: folders, importers, exporters."""

from .dataset_folder import save_dataset as save_dataset
from .easy_handeye import PoseSamples as PoseSamples
from .easy_handeye import read_easy_handeye as read_easy_handeye
from .easy_handeye import write_easy_handeye as write_easy_handeye
from .export import opencv_coefficients as opencv_coefficients
from .export import opencv_yaml as opencv_yaml
from .export import ros_camera_info as ros_camera_info
from .export import ros_static_transform as ros_static_transform
from .export import urdf_origin as urdf_origin
from .load import load_dataset as load_dataset
from .matrix_rows import import_matrix_rows as import_matrix_rows
from .matrix_rows import read_matrix_rows as read_matrix_rows
from .matrix_rows import write_matrix_rows as write_matrix_rows
from .opencv_camera import read_opencv_camera as read_opencv_camera
from .pairs import import_pairs as import_pairs
from .pictures import from_pictures as from_pictures
from .robot_cal_kinematics import read_robot_cal_kinematics as read_robot_cal_kinematics
from .robot_cal_tools import import_robot_cal_tools as import_robot_cal_tools
from .sample import sample_folder as sample_folder
from .urdf import load_urdf as load_urdf
from .visp import import_visp as import_visp
from .visp import read_visp_camera as read_visp_camera
from .visp import read_visp_pose as read_visp_pose
from .visp import write_visp_pose as write_visp_pose
