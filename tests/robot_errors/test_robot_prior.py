import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax.robot_errors import LinearInPose, LinearInPosition, RobotPrior


@pytest.fixture(scope="module")
def field():
    poses = np.random.default_rng(0).normal(size=(12, 6)) * [0.2, 0.3, 0.1, 0.8, 0.8, 0.8]
    return LinearInPose.over(SE3.exp(jnp.asarray(poses)))


def test_medians_are_those_of_arms_over_the_reach_of_the_views(field):
    """A millimetre a metre is as many millimetres as the field's unit has metres."""
    found = RobotPrior().medians(field)
    assert found[:2] == pytest.approx([5e-5, 1e-4])
    reach = float(field.reach)
    by_name = dict(zip([name for name, _ in field.groups], found[2:], strict=True))
    assert by_name["translation_by_position"] == pytest.approx(1e-3 * reach)
    assert by_name["rotation_by_orientation"] == pytest.approx(1e-3)
    assert len(RobotPrior().spreads(field)) == 2 + len(field.groups)
    assert len(RobotPrior().medians(None)) == 2


def test_a_users_own_arm_takes_the_place_of_the_usual_one(field):
    prior = RobotPrior(translation=1e-3, groups={"translation_by_position": 5e-3}, other=0.1)
    found = prior.medians(LinearInPosition(field.centre, jnp.asarray(1.0)))
    np.testing.assert_allclose(found, [1e-3, 1e-4, 5e-3, 0.1])
    spreads = prior.spreads(LinearInPosition(field.centre, jnp.asarray(1.0)))
    assert spreads[2] == pytest.approx(np.log(prior.field_spread))
    assert spreads[3] == pytest.approx(np.log(prior.other_spread))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"translation": 0.0}, "RobotPrior.translation: expected a positive number, found 0.0"),
        ({"rotation": np.nan}, "RobotPrior.rotation: expected a positive number, found nan"),
        ({"groups": {"sag": -1.0}}, r"RobotPrior.groups\['sag'\]: expected a positive number"),
        ({"spread": 1.0}, "RobotPrior.spread: expected a factor above 1, found 1.0"),
        ({"wrong_target": 1.0}, "RobotPrior.wrong_target: expected a probability below 1"),
    ],
)
def test_what_cannot_be_is_refused(options, words):
    with pytest.raises(ValueError, match=words):
        RobotPrior(**options)
