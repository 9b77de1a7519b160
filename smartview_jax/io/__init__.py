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
from .meshes import face_triangles as face_triangles
from .meshes import model_from_triangles as model_from_triangles
from .meshes import read_mesh as read_mesh
from .meshes import to_trimesh as to_trimesh
from .meshes import write_mesh as write_mesh
from .object_models import load_object_model as load_object_model
from .object_models import object_model_from_dict as object_model_from_dict
from .object_models import object_model_to_dict as object_model_to_dict
from .object_models import save_object_model as save_object_model
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
