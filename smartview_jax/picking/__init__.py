"""Run a whole cell: calibrate it, find objects, verify them from chosen views, grasp them."""

from .calibrating import BoardViews as BoardViews
from .calibrating import CellCalibration as CellCalibration
from .calibrating import calibrate_cell as calibrate_cell
from .clicking import SeenObject as SeenObject
from .clicking import model_by_clicks as model_by_clicks
from .demo import DemoResult as DemoResult
from .demo import run_demo as run_demo
from .looking import BadPictureError as BadPictureError
from .looking import FirstViews as FirstViews
from .looking import Look as Look
from .looking import LookOptions as LookOptions
from .looking import Region as Region
from .looking import look_for as look_for
from .pick import Pick as Pick
from .pick import execute as execute
from .pick import pick as pick
