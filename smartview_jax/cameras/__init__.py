"""Camera models: four pinhole parameters and a lens, with one lens model in each file."""

from .camera import Camera as Camera
from .camera import in_picture as in_picture
from .circles import circle_centre_bias as circle_centre_bias
from .circles import circle_image_centre as circle_image_centre
from .fisheye import Fisheye as Fisheye
from .inversion import implicit_inverse as implicit_inverse
from .lens import AbstractLens as AbstractLens
from .lens import AbstractPerspectiveLens as AbstractPerspectiveLens
from .lens import Pinhole as Pinhole
from .opencv import AbstractOpenCVLens as AbstractOpenCVLens
from .opencv import OpenCV4 as OpenCV4
from .opencv import OpenCV5 as OpenCV5
from .opencv import OpenCV8 as OpenCV8
from .radial import Radial as Radial
from .registry import LENSES as LENSES
from .registry import camera_from_dict as camera_from_dict
from .registry import camera_to_dict as camera_to_dict
from .registry import initial_lens as initial_lens
from .registry import lens_by_name as lens_by_name
from .registry import lens_name as lens_name
from .symmetric_lens import MIN_LENS_POINTS as MIN_LENS_POINTS
from .symmetric_lens import SymmetricLensFit as SymmetricLensFit
from .symmetric_lens import fit_symmetric_lens as fit_symmetric_lens
from .symmetric_lens import spanned_coordinates as spanned_coordinates
from .weng import Weng as Weng
