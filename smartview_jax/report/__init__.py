"""Present a calibration as tables, plots and an HTML page."""

from .page import write_page as write_page
from .tables import COMPARED as COMPARED
from .tables import Summary as Summary
from .tables import budget_rows as budget_rows
from .tables import compared as compared
from .tables import explanation_rows as explanation_rows
from .tables import halves_agree as halves_agree
from .tables import rejections as rejections
from .tables import remarks as remarks
from .tables import summaries as summaries
from .tables import table_rows as table_rows
from .tables import verdict as verdict
