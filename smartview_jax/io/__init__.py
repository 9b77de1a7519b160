"""Data sets and calibrations on disk: folders, importers, exporters."""

from .dataset_folder import save_dataset as save_dataset
from .load import load_dataset as load_dataset
from .pairs import import_pairs as import_pairs
from .robot_cal_tools import import_robot_cal_tools as import_robot_cal_tools
from .sample import sample_folder as sample_folder
