"""Present a calibration, or a whole run, as tables, plots and an HTML page."""

from .localization_page import LOCALIZATION_HEADINGS as LOCALIZATION_HEADINGS
from .localization_page import localization_rows as localization_rows
from .localization_page import localization_verdict as localization_verdict
from .localization_page import write_localization_page as write_localization_page
from .page import Origin as Origin
from .page import write_evaluation_page as write_evaluation_page
from .page import write_page as write_page
from .pose_page import pose_error_rows as pose_error_rows
from .pose_page import pose_fit_summary as pose_fit_summary
from .pose_page import write_pose_page as write_pose_page
from .story import Section as Section
from .story import StoryFigure as StoryFigure
from .story import write_story as write_story
from .tables import COMPARISON_HEADINGS as COMPARISON_HEADINGS
from .tables import ErrorSummary as ErrorSummary
from .tables import budget_rows as budget_rows
from .tables import comparison_row as comparison_row
from .tables import error_summaries as error_summaries
from .tables import headline as headline
from .tables import rejections as rejections
from .tables import remarks as remarks
from .tables import repeatability_rows as repeatability_rows
from .tables import result_summary as result_summary
from .tables import scale_hypothesis_rows as scale_hypothesis_rows
from .tables import table_rows as table_rows
