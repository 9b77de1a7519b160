"""Judge poses: which edges they explain, what else may explain these, and the verdict."""

from .candidates import Candidate as Candidate
from .candidates import Prepared as Prepared
from .candidates import Query as Query
from .candidates import converged_candidates as converged_candidates
from .candidates import measured_candidates as measured_candidates
from .evidence import evidence_of as evidence_of
from .judging import MAX_REJECTED as MAX_REJECTED
from .judging import judged as judged
from .judging import scene_without as scene_without
from .localization import Localization as Localization
from .localization import Localizations as Localizations
from .localization import model_name as model_name
from .options import DEFAULT_OPTIONS as DEFAULT_OPTIONS
from .options import VerdictOptions as VerdictOptions
from .scene import Claim as Claim
from .scene import Scene as Scene
from .verdict import judge as judge
from .verdict import relative_std as relative_std
