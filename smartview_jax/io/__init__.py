"""Read and write data sets and calibrations: folders, importers, exporters."""

from ..deprecation import deprecated_names as _deprecated_names
from .correspondences import import_correspondences as import_correspondences
from .dataset_folder import save_dataset as save_dataset
from .dataset_folder import write_dataset_folder as write_dataset_folder
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
from .pictures import dataset_from_pictures as dataset_from_pictures
from .robot_cal_kinematics import read_robot_cal_kinematics as read_robot_cal_kinematics
from .robot_cal_tools import import_robot_cal_tools as import_robot_cal_tools
from .rough_pose import parse_rough_pose as parse_rough_pose
from .sample import sample_folder as sample_folder
from .urdf import load_urdf as load_urdf
from .viewpoints import Viewpoints as Viewpoints
from .viewpoints import pose_columns as pose_columns
from .viewpoints import read_viewpoints as read_viewpoints
from .viewpoints import val_program as val_program
from .viewpoints import write_viewpoints as write_viewpoints
from .visp import import_visp as import_visp
from .visp import read_visp_camera as read_visp_camera
from .visp import read_visp_pose as read_visp_pose
from .visp import write_visp_pose as write_visp_pose

__getattr__ = _deprecated_names(__name__)
