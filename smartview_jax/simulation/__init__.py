"""Simulate calibration scenes with known truth: geometry, noise and rendered pictures."""

from .arm_scenes import ArmScene as ArmScene
from .arm_scenes import six_axis_scene as six_axis_scene
from .paper import PICTURED as PICTURED
from .paper import PaperSetUp as PaperSetUp
from .paper import paper_photographs as paper_photographs
from .paper import paper_scene as paper_scene
from .paper import paper_unseen as paper_unseen
from .paper import paper_viewpoints as paper_viewpoints
from .photograph import photograph as photograph
from .render import render as render
from .render import write_pictures as write_pictures
from .scenes import Scene as Scene
from .scenes import look_at as look_at
from .scenes import paper_calibration as paper_calibration
from .scenes import paper_points as paper_points
from .scenes import random_scene as random_scene
from .scenes import reported_poses as reported_poses
from .scenes import simulate as simulate
from .scenes import views_around as views_around
