"""Find straight segments, corners and edges in pictures of objects."""

from .appearance import Appearance as Appearance
from .appearance import describe as describe
from .appearance import similarities as similarities
from .edge_maps import edge_map as edge_map
from .edge_points import EdgePoints as EdgePoints
from .features import Features as Features
from .features import find as find
from .ideal_plane import IdealPlane as IdealPlane
