"""Match corners of several views, and propose points and edges: epipolar curves, tracks."""

from .candidates import Candidates as Candidates
from .candidates import direction_turn as direction_turn
from .candidates import rank_candidates as rank_candidates
from .epipolar import EpipolarCurve as EpipolarCurve
from .epipolar import epipolar_curve as epipolar_curve
from .epipolar import epipolar_curves as epipolar_curves
from .proposal import ModelProposal as ModelProposal
from .proposal import propose_model as propose_model
from .region import Region as Region
