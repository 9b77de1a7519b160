from .empirical_bayes import FleetPrior as FleetPrior
from .empirical_bayes import fleet_prior as fleet_prior
from .execution import Outcome as Outcome
from .execution import outcomes as outcomes
from .many import ManyOutcome as ManyOutcome
from .many import calibrate_many as calibrate_many
