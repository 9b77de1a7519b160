"""The problem of two arms that see two targets: its optimum, and its derivatives there."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from arms_scene import FOUR_CAMERAS, NOISE, arms_scene
from scipy_optimum import scipy_optimum

from smartview_jax import Prior
from smartview_jax.engine import ParameterChoice, build_arms, build_rig, choices_of_arms, solve


def test_scipy_finds_the_same_optimum_and_derivatives():
    """The lenses are known, and both targets couple the arms."""
    rig, truths = arms_scene(0, FOUR_CAMERAS, 4)
    solved = {}
    for arm in rig.arm_names:
        part = rig.of_arm(arm)
        starts = {name: truths[name] for name in part.cameras}
        lenses = [f"{name}.camera" for name in part.cameras]
        built = build_rig(part, starts, noise=NOISE, fixed=lenses)
        solved[arm] = built, solve(built.problem)[0].z
    built, start = build_arms(rig, solved)
    problem = built.problem
    solution, equations = solve(problem, start=start)
    found, unravel = scipy_optimum(problem, start, method="lm")
    assert found.cost == pytest.approx(solution.costs[-1], rel=1e-9)
    by_scipy = unravel(jnp.asarray(found.x))
    np.testing.assert_allclose(by_scipy.per_view, solution.z.per_view, atol=1e-8)
    shared = len(start.shared)
    own = np.asarray(equations.matrix.shared)
    squares = (found.jac.T @ found.jac)[:shared, :shared]
    sizes = np.sqrt(np.outer(np.diagonal(own), np.diagonal(own)))
    np.testing.assert_allclose(own / sizes, squares / sizes, atol=1e-6)
    # The second arm's own parameters follow by the same derivatives on the host.
    step, arm = np.asarray(problem.unscaled_step(solution.z).shared), problem.arms[1]
    automatic = eqx.filter_jit(lambda arm, step: jax.jacfwd(arm.own_step)(step))(arm, step)
    np.testing.assert_allclose(arm.host_jacobian(step), automatic, atol=1e-9)


def test_the_order_of_the_starts_changes_nothing():
    """Each value belongs to its camera, in whichever order the cameras' starts are given."""
    rig, truths = arms_scene(0, FOUR_CAMERAS, 4)

    def values(starts):
        """The start values of the free parameters by their names."""
        arms = {}
        for arm in rig.arm_names:
            part = rig.of_arm(arm)
            of_arm = {name: start for name, start in starts.items() if name in part.cameras}
            built = build_rig(part, of_arm, noise=NOISE)
            arms[arm] = built, built.problem.zero_step()
        built, _ = build_arms(rig, arms)
        free = np.asarray(built.problem.free)
        return dict(zip(built.shared_names, built.problem.host_start_values()[free], strict=True))

    assert values(dict(reversed(truths.items()))) == values(truths)


def test_square_pixels_of_one_camera_are_known_in_the_fit_of_all_arms():
    """One of four cameras; the priors of the arms are those of all."""
    rig, truths = arms_scene(0, FOUR_CAMERAS, 4)
    camera = tuple(truths)[-1]
    path, alpha_v = f"{camera}.camera.pixel_aspect", f"{camera}.camera.alpha_v"
    choice = ParameterChoice.of(priors={path: Prior(mean=1.0, std=1e-4)})
    choices = choices_of_arms(rig, truths, choice)
    arms = {}
    for arm in rig.arm_names:
        part = rig.of_arm(arm)
        starts = {name: truths[name] for name in part.cameras}
        built = build_rig(part, starts, noise=NOISE, **choices[arm]._asdict())
        arms[arm] = built, built.problem.zero_step()
    built, start = build_arms(rig, arms)
    problem, names = built.problem, built.shared_names
    place = names.index(alpha_v)
    assert np.asarray(problem.prior_weight.shared)[np.asarray(problem.free)][place] == 1e4
    lens = truths[camera].camera
    expected = np.eye(len(names))
    ratio = float(lens.alpha_v) / float(lens.alpha_u)
    expected[place, names.index(f"{camera}.camera.alpha_u")] = ratio
    expected[place, place] = float(lens.alpha_u)
    np.testing.assert_allclose(problem.host_named_by_fitted(start), expected, rtol=1e-12)
    row = np.linalg.inv(expected)[place]
    known = 1e8 * np.outer(row, row)
    np.testing.assert_allclose(problem.host_prior_information(), known, rtol=1e-9, atol=1e-9)
