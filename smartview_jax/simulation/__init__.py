"""Simulate calibration scenes with known truth: geometry, noise and rendered pictures."""

from ..deprecation import deprecated_names as _deprecated_names
from .arm_scenes import ArmScene as ArmScene
from .arm_scenes import six_axis_scene as six_axis_scene
from .paper import RENDERED_PAPER_SETUP as RENDERED_PAPER_SETUP
from .paper import PaperSetUp as PaperSetUp
from .paper import paper_held_out as paper_held_out
from .paper import paper_rendered_scene as paper_rendered_scene
from .paper import paper_scene as paper_scene
from .paper import paper_viewpoints as paper_viewpoints
from .render import render as render
from .render import write_pictures as write_pictures
from .rendered_scenes import rendered_scene as rendered_scene
from .scenes import Scene as Scene
from .scenes import look_at_from_above as look_at_from_above
from .scenes import paper_calibration as paper_calibration
from .scenes import paper_points as paper_points
from .scenes import random_scene as random_scene
from .scenes import random_viewpoints as random_viewpoints
from .scenes import reported_poses as reported_poses
from .scenes import simulate as simulate

__getattr__ = _deprecated_names(__name__)
