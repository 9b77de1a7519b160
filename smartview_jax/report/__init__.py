"""What a person sees: tables, plots and the HTML page."""

from .page import write_page as write_page
from .tables import COMPARED as COMPARED
from .tables import MEASURES as MEASURES
from .tables import Summary as Summary
from .tables import cells as cells
from .tables import compared as compared
from .tables import rejections as rejections
from .tables import remarks as remarks
from .tables import summaries as summaries
from .tables import verdict as verdict
