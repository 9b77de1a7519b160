import inspect
from typing import get_type_hints

from smartview_jax import fit_joint
from smartview_jax.joint import JointOptions

SAID_BY_WHO_PASSES_THEM_ON = {"data", "start", "lens", "inliers", "progress"}


def test_options_are_those_of_the_fit():
    parameters = inspect.signature(fit_joint).parameters
    assert set(get_type_hints(JointOptions)) == set(parameters) - SAID_BY_WHO_PASSES_THEM_ON
