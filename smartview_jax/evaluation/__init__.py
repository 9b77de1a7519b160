"""How good a calibration is: deviations, held-out error, methods side by side."""

from .compare import METHODS as METHODS
from .compare import Row as Row
from .compare import compare as compare
from .held_out import HeldOut as HeldOut
from .held_out import held_out as held_out
from .held_out import view_folds as view_folds
from .measures import Deviations as Deviations
from .measures import Predictor as Predictor
from .measures import deviations as deviations
