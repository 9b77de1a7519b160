"""Plan viewpoints: wanted camera poses, the robot commands for them, and the best next views."""

from ..geometry import FIVE_STEP as FIVE_STEP
from ..geometry import direction_of as direction_of
from ..geometry import five_viewpoints as five_viewpoints
from ..geometry import look_at as look_at
from .checks import DANGERS as DANGERS
from .checks import REASONS as REASONS
from .checks import Checks as Checks
from .checks import Limits as Limits
from .checks import Table as Table
from .choice import ChosenViews as ChosenViews
from .choice import choose_views as choose_views
from .commands import ViewCalibration as ViewCalibration
from .commands import ViewpointCommands as ViewpointCommands
from .commands import predict as predict
from .commands import viewpoint_commands as viewpoint_commands
from .goals import Goal as Goal
from .goals import everything as everything
from .goals import hand_eye as hand_eye
from .goals import held_out as held_out
from .selection import curve as curve
from .selection import views_needed as views_needed
from .survey import Survey as Survey
from .view_range import ViewRange as ViewRange
