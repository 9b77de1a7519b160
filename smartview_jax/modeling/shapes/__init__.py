"""Describe an object: its faces, symmetry, dimensions and grasps."""

from .dimensions import Dimension as Dimension
from .dimensions import angle as angle
from .dimensions import dimension as dimension
from .faces import PLANAR_TOLERANCE as PLANAR_TOLERANCE
from .faces import SHARP_ANGLE as SHARP_ANGLE
from .faces import Face as Face
from .faces import FacePlane as FacePlane
from .faces import check_face as check_face
from .faces import face_array as face_array
from .faces import face_plane as face_plane
from .faces import faces_by_edge as faces_by_edge
from .faces import open_edges as open_edges
from .faces import oriented_outward as oriented_outward
from .faces import points_in_loops as points_in_loops
from .faces import signed_volume as signed_volume
from .grasp_frames import Grasp as Grasp
from .grasp_frames import grasp_on_face as grasp_on_face
from .grasp_frames import turned as turned
from .grasp_frames import width_between_fingers as width_between_fingers
from .grasp_frames import widths_between_fingers as widths_between_fingers
from .object_model import ObjectModel as ObjectModel
from .object_model import edges_of_faces as edges_of_faces
from .symmetry import Symmetry as Symmetry
from .symmetry import SymmetryAxis as SymmetryAxis
from .symmetry_search import find_symmetry as find_symmetry
from .symmetry_search import rim_vertices as rim_vertices
