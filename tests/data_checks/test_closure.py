"""The closure errors of several explanations at once equal each one's alone."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.data_checks import closure_error, relative_motions
from smartview_jax.data_checks.closure import RelativeMotions, closure_errors

EXPLANATIONS, VIEWS = 3, 9


def random_poses(rng):
    poses = np.tile(np.eye(4), (EXPLANATIONS, VIEWS, 1, 1))
    count = EXPLANATIONS * VIEWS
    poses[..., :3, :3] = (
        Rotation.from_rotvec(rng.normal(0.0, 0.6, (count, 3)))
        .as_matrix()
        .reshape(EXPLANATIONS, VIEWS, 3, 3)
    )
    poses[..., :3, 3] = rng.normal([0.0, 0.0, 1.0], 0.3, (EXPLANATIONS, VIEWS, 3))
    return poses


@pytest.fixture(scope="module")
def explained():
    """Robot and camera poses that one hand-eye transform explains but for noise, and a bad view."""
    rng = np.random.default_rng(0)
    camera = random_poses(rng)
    hand_eye = random_poses(rng)[:, :1]
    noise = np.tile(np.eye(4), (EXPLANATIONS, VIEWS, 1, 1))
    noise[..., :3, 3] += rng.normal(0.0, 1e-3, (EXPLANATIONS, VIEWS, 3))
    robot = np.linalg.inv(hand_eye) @ camera @ noise
    robot[1, 4] = random_poses(rng)[0, 0]
    return robot, camera


def test_a_batch_of_motions_is_that_of_each(explained):
    together = relative_motions(*explained)
    for k, poses in enumerate(zip(*explained, strict=True)):
        for name, values, alone in zip(
            RelativeMotions._fields, together, relative_motions(*poses), strict=True
        ):
            np.testing.assert_allclose(values[k], alone, atol=1e-12, err_msg=name)


def test_the_closure_errors_of_a_batch_and_of_several_scales_are_those_of_each(explained):
    scales = np.array([1.0, 0.1, 30.0, 2.0])
    motions = RelativeMotions(*(values[:, None] for values in relative_motions(*explained)))
    together = closure_errors(motions, scales)
    for k, poses in enumerate(zip(*explained, strict=True)):
        for number, scale in enumerate(scales):
            alone = closure_error(relative_motions(*poses), float(scale))
            np.testing.assert_allclose(together[k, number], alone, rtol=1e-9)
    # The right scale closes, one bad view or not, and the others do not.
    assert (together[:, 0, 1] < 5e-3).all()
    assert (together[:, 1:, 1] > 0.05).all()
