"""Edit object models by clicking features in several views: session, page and widget."""

from .conversation import Conversation as Conversation
from .disagreements import Disagreement as Disagreement
from .document import DrawnConstraint as DrawnConstraint
from .document import DrawnFace as DrawnFace
from .document import PlacedGrasp as PlacedGrasp
from .local_page import PageAccess as PageAccess
from .local_page import serve_page as serve_page
from .owner_lock import OwnerLock as OwnerLock
from .server import serve as serve
from .session import ModelSession as ModelSession
from .suggestions import Suggestion as Suggestion
from .view_geometry import PointEstimate as PointEstimate
from .widget import editor_widget as editor_widget
