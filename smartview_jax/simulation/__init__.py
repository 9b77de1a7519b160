"""Simulate calibration scenes with known truth: geometry, noise and rendered pictures."""

from ..deprecation import deprecated_names as _deprecated_names
from .arm_scenes import ArmScene as ArmScene
from .arm_scenes import six_axis_scene as six_axis_scene
from .object_example import ObjectExample as ObjectExample
from .object_example import example_solid as example_solid
from .object_example import object_example as object_example
from .object_example import object_example_boards as object_example_boards
from .object_example import write_object_example as write_object_example
from .paper import RENDERED_PAPER_SETUP as RENDERED_PAPER_SETUP
from .paper import PaperSetUp as PaperSetUp
from .paper import paper_held_out as paper_held_out
from .paper import paper_rendered_scene as paper_rendered_scene
from .paper import paper_scene as paper_scene
from .paper import paper_viewpoints as paper_viewpoints
from .polyhedra import Polyhedron as Polyhedron
from .polyhedra import box as box
from .polyhedra import prism as prism
from .polyhedra import random_polyhedron as random_polyhedron
from .polyhedra import roofed_block as roofed_block
from .polyhedra import stepped_block as stepped_block
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
from .solid_scenes import Light as Light
from .solid_scenes import SolidScene as SolidScene
from .solid_scenes import Surface as Surface
from .solid_scenes import render_solids as render_solids
from .textures import labelled as labelled
from .textures import matt as matt
from .textures import speckled as speckled

__getattr__ = _deprecated_names(__name__)
