"""What views say about a robot's errors, against the same views with other priors."""

import numpy as np
from linear_world import CAMERA, FIELD, MOUNT, SHARED, TRUTH, VIEWS, drawn, linear_world, linearised
from scipy.stats import multivariate_normal

from smartview_jax.robot_errors import ErrorsOfType, JointOffsets
from smartview_jax.robots import six_axes
from smartview_jax.variance.likelihood import marginalise
from smartview_jax.variance.robot_evidence import about_zero

ERRORS = np.arange(CAMERA + MOUNT, SHARED)


def means():
    """Prior means of the errors, with a covariance of rank two."""
    rng = np.random.default_rng(1)
    return rng.normal(size=sum(FIELD)), 0.5 * rng.normal(size=(sum(FIELD), 2))


def textbook(world, observed, mean, covariance):
    """The restricted likelihood with a prior of the errors about a mean, on dense matrices."""
    information, design = world[:2]
    each = np.tile(np.repeat([TRUTH.translation, TRUTH.rotation], 3), VIEWS) ** 2
    sizes = np.repeat(np.asarray(TRUTH.field) ** 2, FIELD)
    fixed, errors, own = design[:, : CAMERA + MOUNT], design[:, ERRORS], design[:, SHARED:]
    V = float(TRUTH.pixel) ** 2 * np.linalg.inv(information) + (own * each) @ own.T
    V = V + errors @ (np.diag(sizes) + covariance) @ errors.T
    inverse, shifted = np.linalg.inv(V), observed - errors @ mean
    normal = fixed.T @ inverse @ fixed
    found = np.linalg.solve(normal, fixed.T @ inverse @ shifted)
    density = multivariate_normal.logpdf(shifted, fixed @ found, V)
    return -2.0 * density + np.linalg.slogdet(normal)[1], found


def test_the_errors_of_a_type_are_a_prior_about_their_mean():
    world, (mean, root) = linear_world(), means()
    differences = []
    for seed in (0, 1):
        observed = drawn(world, seed)
        at = np.random.default_rng(8).normal(size=SHARED + 6 * VIEWS)
        views = linearised(world, observed, at).about_common(ERRORS, mean, root)
        marginal = marginalise(views, TRUTH)
        deviance, found = textbook(world, observed, mean, root @ root.T)
        np.testing.assert_allclose(
            at[: CAMERA + MOUNT] + marginal.step.shared[: CAMERA + MOUNT], found, rtol=1e-6
        )
        differences.append(marginal.deviance - deviance)
    # Up to a constant.
    np.testing.assert_allclose(differences[0], differences[1], rtol=1e-9)


def test_a_fit_about_a_type_tells_the_same_as_one_about_zero():
    world, (mean, root) = linear_world(), means()
    views = linearised(world, drawn(world, 0))
    common = np.arange(SHARED, SHARED + root.shape[1])
    about = views.about_common(ERRORS, mean, root)
    # As in a fit, whose common errors are a group of their own.
    about = about._replace(group_index=np.append(views.group_index, np.full(len(common), 2)))
    again = about.without_common(ERRORS, common, mean, root)
    for sizes in (TRUTH, TRUTH._replace(pixel=2.0)):
        np.testing.assert_allclose(
            marginalise(again, sizes).deviance, marginalise(views, sizes).deviance, rtol=1e-12
        )


def test_errors_that_a_fit_holds_are_left_out():
    """Of six zeros the third is held; then one of the two common errors, or all errors, too."""
    rng, world = np.random.default_rng(2), linear_world()
    field = ErrorsOfType.of(JointOffsets(six_axes()), rng.normal(size=6), rng.normal(size=(6, 2)))
    mean, root = (np.delete(np.asarray(x), 2, axis=0) for x in (field.mean, field.root))
    others = tuple(f"other.{k}" for k in range(CAMERA + MOUNT))
    zeros = tuple(f"robot_error.joint_offset.{k}" for k in (1, 2, 4, 5, 6))
    views = linearised(world, drawn(world, 0))
    for free in (("1", "2"), ("2",), ()):
        of_free = root[:, [int(number) - 1 for number in free]]
        about = views.about_common(ERRORS, mean, of_free)
        common = tuple(f"robot_error.common_error.{number}" for number in free)
        again, names = about_zero(about, (*others, *zeros, *common), field)
        assert names == (*others, *zeros)
        np.testing.assert_allclose(
            marginalise(again, TRUTH).deviance, marginalise(views, TRUTH).deviance, rtol=1e-12
        )
    without = views.with_held(np.arange(SHARED) >= CAMERA + MOUNT)
    again, names = about_zero(without, others, field)
    assert names == others
    assert marginalise(again, TRUTH).deviance == marginalise(without, TRUTH).deviance
