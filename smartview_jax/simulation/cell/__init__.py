"""Simulate a robot cell with real physics, and define the interface of simulated and real cells."""

from .driver_cell import DriverCell as DriverCell
from .fixtures import Bin as Bin
from .fixtures import FixedBox as FixedBox
from .interface import Cell as Cell
from .interface import CellError as CellError
from .objects import CellObject as CellObject
from .objects import convex_parts as convex_parts
from .physics import Physics as Physics
from .simulated_cell import Judgement as Judgement
from .simulated_cell import SimulatedCell as SimulatedCell
from .truth import BOARD as BOARD
from .truth import CellTruth as CellTruth
from .truth import drawn_calibration as drawn_calibration
from .truth import random_truth as random_truth
