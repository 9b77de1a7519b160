"""Names that moved are found at their old place for one release, with a word on where they are."""

import pytest
from test_layers import FILES, imports_of

import smartview_jax as sv

MOVED = {
    "joint": {
        "engine": """
            AbstractLoss Cauchy GemanMcClure Huber JointProblem Noise Observability Prior
            StructuredLM StudentT build_problem optimum parameter_names
        """,
        "variance": "Alternative NoiseEstimate estimate_noise",
        "arm_identification": "KinematicFit fit_kinematics",
        "calibrate_data": "CalibrationFit best_uncorrected calibrate",
    },
    "robots": {
        "robot_errors": """
            AbstractField AbstractLinearField CombinedField DHErrors ImpliedArm JointOffsets
            JointRatios LinearInPose LinearInPosition PoseOrStretch RobotError RobotPrior Stretched
            arm_of field_by_name field_name robot_error_from_dict robot_error_to_dict
        """
    },
    "staged": {"fit_result": "FitCode FitResult"},
}

NAMES = [
    (old, new, name)
    for old, places in MOVED.items()
    for new, names in places.items()
    for name in names.split()
]


@pytest.mark.parametrize(("old", "new", "name"), NAMES)
def test_an_old_name_still_works_and_says_where_it_is(old, new, name):
    with pytest.warns(DeprecationWarning, match=rf"now smartview_jax\.{new}\.{name};"):
        found = getattr(getattr(sv, old), name)
    assert found is getattr(getattr(sv, new), name)


@pytest.mark.parametrize("old", MOVED)
def test_a_name_that_never_was_is_an_attribute_error(old):
    with pytest.raises(AttributeError, match=f"'smartview_jax.{old}' has no attribute 'never'"):
        _ = getattr(sv, old).never


def test_the_package_itself_asks_for_no_old_name():
    """A name that points upwards would else hide an import from a room above."""
    old_names = {f"smartview_jax.{old}.{name}" for old, _, name in NAMES}
    assert not old_names & {name for file in FILES for name in imports_of(file)}
