"""Cameras: four pinhole numbers and a lens, one lens model a file."""

from .camera import Camera as Camera
from .lens import AbstractLens as AbstractLens
from .lens import AbstractPerspectiveLens as AbstractPerspectiveLens
from .names import lens_by_name as lens_by_name
from .names import lens_name as lens_name
from .pinhole import Pinhole as Pinhole
from .radial import Radial as Radial
