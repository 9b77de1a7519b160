"""Find straight segments, corners and edges in pictures of objects."""

from .appearance import Appearance as Appearance
from .appearance import describe as describe
from .edge_points import EdgePoints as EdgePoints
from .edge_points import edge_map as edge_map
from .ellipses import EllipseOptions as EllipseOptions
from .ellipses import find_ellipses as find_ellipses
from .features import Features as Features
from .features import find as find
from .gradient import SMOOTHING as SMOOTHING
from .ideal_plane import IdealPlane as IdealPlane
from .lone_edges import CLEARANCE as CLEARANCE
from .lone_edges import lone_points as lone_points
from .picture_evidence import DISTANCE_STEP as DISTANCE_STEP
from .picture_evidence import FAR as FAR
from .picture_evidence import ORIENTATIONS as ORIENTATIONS
from .picture_evidence import UNSEEN as UNSEEN
from .picture_evidence import EdgeMaps as EdgeMaps
from .picture_evidence import PictureEvidence as PictureEvidence
from .picture_evidence import edge_maps as edge_maps
from .picture_evidence import evidence_of_points as evidence_of_points
from .picture_evidence import picture_evidence as picture_evidence
from .picture_scale import STANDARD_WIDTH as STANDARD_WIDTH
from .picture_scale import edge_width as edge_width
from .picture_scale import scaled_camera as scaled_camera
