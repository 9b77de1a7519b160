"""Find the poses at which known objects may be in the pictures, without an initial pose."""

from .hypotheses import Hypothesis as Hypothesis
from .hypotheses import at_one_scale as at_one_scale
from .hypotheses import checked_box as checked_box
from .hypotheses import find_hypotheses as find_hypotheses
from .options import DEFAULT_SEARCH_OPTIONS as DEFAULT_SEARCH_OPTIONS
from .options import SearchOptions as SearchOptions
