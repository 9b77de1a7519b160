import pickle

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.robot_errors import LinearInPose, LinearInPosition, RobotPrior


@pytest.fixture(scope="module")
def field():
    poses = np.random.default_rng(0).normal(size=(12, 6)) * [0.2, 0.3, 0.1, 0.8, 0.8, 0.8]
    return LinearInPose.from_poses(SE3.exp(jnp.asarray(poses)))


def test_medians_are_those_of_arms_over_the_reach_of_the_views(field):
    """A millimetre a metre is as many millimetres as the field's unit has metres."""
    found = RobotPrior().medians(field)
    assert found[:2] == pytest.approx([5e-5, 1e-4])
    reach = float(field.reach)
    by_name = dict(zip([name for name, _ in field.groups], found[2:], strict=True))
    assert by_name["translation_by_position"] == pytest.approx(1e-3 * reach)
    assert by_name["rotation_by_orientation"] == pytest.approx(1e-3)
    assert len(RobotPrior().log_stds(field)) == 2 + len(field.groups)
    assert len(RobotPrior().medians(None)) == 2


def test_a_users_own_arm_takes_the_place_of_the_usual_one(field):
    prior = RobotPrior(
        translation_median=1e-3,
        group_medians={"translation_by_position": 5e-3},
        other_group_median=0.1,
    )
    found = prior.medians(LinearInPosition(field.centre, jnp.asarray(1.0)))
    np.testing.assert_allclose(found, [1e-3, 1e-4, 5e-3, 0.1])
    spreads = prior.log_stds(LinearInPosition(field.centre, jnp.asarray(1.0)))
    assert spreads[2] == pytest.approx(np.log(prior.group_geometric_std))
    assert spreads[3] == pytest.approx(np.log(prior.other_group_geometric_std))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"translation_median": 0.0}, "RobotPrior.translation_median: expected a positive number"),
        ({"rotation_median": np.nan}, "RobotPrior.rotation_median: .* positive number, found nan"),
        ({"group_medians": {"sag": -1.0}}, r"group_medians\['sag'\]: expected a positive number"),
        ({"geometric_std": 1.0}, "RobotPrior.geometric_std: expected a factor above 1, found 1.0"),
        ({"wrong_target_probability": 1.0}, "expected a probability below 1, found 1.0"),
    ],
)
def test_what_cannot_be_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        RobotPrior(**options)


def test_a_prior_goes_to_another_process_and_back():
    assert pickle.loads(pickle.dumps(RobotPrior())) == RobotPrior()
