"""Model objects from several calibrated views: geometry, triangulation, surfaces and grasps."""

from .epipolar import EpipolarCurve as EpipolarCurve
from .epipolar import epipolar_curve as epipolar_curve
from .epipolar import epipolar_curves as epipolar_curves
from .faces import PLANAR_TOLERANCE as PLANAR_TOLERANCE
from .faces import Face as Face
from .faces import FacePlane as FacePlane
from .faces import check_face as check_face
from .faces import face_array as face_array
from .faces import face_plane as face_plane
from .faces import open_edges as open_edges
from .faces import oriented_outward as oriented_outward
from .faces import signed_volume as signed_volume
from .grasp_frames import Grasp as Grasp
from .grasp_frames import grasp_on_face as grasp_on_face
from .grasp_frames import turned as turned
from .grasp_frames import width_between_fingers as width_between_fingers
from .line_jacobians import Lines as Lines
from .line_triangulation import TriangulatedLines as TriangulatedLines
from .line_triangulation import triangulate_lines as triangulate_lines
from .object_model import ObjectModel as ObjectModel
from .object_model import edges_of_faces as edges_of_faces
from .point_estimation import PointStatus as PointStatus
from .symmetry import Symmetry as Symmetry
from .symmetry import find_symmetry as find_symmetry
from .triangulation import TriangulatedPoints as TriangulatedPoints
from .triangulation import triangulate_points as triangulate_points
