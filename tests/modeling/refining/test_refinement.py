import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3
from scipy.optimize import least_squares
from scipy.stats import chi2, kstest

from smartview_jax.engine import GemanMcClure
from smartview_jax.evaluation import mean_nees
from smartview_jax.geometry import five_viewpoints, host_matrices
from smartview_jax.modeling import (
    EqualLength,
    KnownLength,
    LineIndex,
    ModelObservations,
    OnPlane,
    Parallel,
    PointStatus,
    RightAngle,
    SamePlane,
    Symmetric,
    refine,
    suspect_clicks,
    triangulate_points,
)
from smartview_jax.simulation import reported_poses

SIGMA = 0.3
SIZE = np.array([0.03, 0.02, 0.01])
BOX = np.array([[k & 1, k >> 1 & 1, k >> 2] for k in range(8)]) * SIZE
FACES = [(0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 4, 5), (2, 3, 6, 7), (0, 2, 4, 6), (1, 3, 5, 7)]
"""Of a box whose vertices are numbered by the bits of x, y and z."""

TRUE = [
    *(SamePlane(face) for face in FACES),
    OnPlane((0, 1, 2, 3)),
    *(RightAngle((0, 1), (0, k)) for k in (2, 4)),
    *(Parallel((0, 1), pair) for pair in ((2, 3), (4, 5), (6, 7))),
    EqualLength((0, 2), (5, 7)),
    KnownLength((0, 4), 0.01),
    Symmetric(((0, 1), (2, 3), (4, 5), (6, 7))),
]


@pytest.fixture(scope="module")
def poses(calibration):
    five = five_viewpoints(0.5 * SIZE, 0.2, roll=np.array([0.3, 0, -0.2, 0.5, 1.0]))
    return host_matrices(calibration.command_for(five))


def clicks(calibration, poses, seed=0, sigma=SIGMA, points=BOX):
    pixels = np.array(calibration.project(poses, points)[0])
    return pixels + sigma * np.random.default_rng(seed).standard_normal(pixels.shape)


def observed(calibration, poses, pixels, **rest):
    return ModelObservations(calibration, poses, pixels, pixel_sigma=SIGMA, **rest)


def test_without_constraints_it_is_triangulation(calibration, poses):
    pixels = clicks(calibration, poses)
    refined = refine(None, observed(calibration, poses, pixels))
    alone = triangulate_points(calibration, poses, pixels, pixel_sigma=SIGMA)
    np.testing.assert_allclose(refined.points, alone.points, atol=1e-9)
    np.testing.assert_allclose(refined.picture_covariance, alone.picture_covariance, rtol=1e-4)
    np.testing.assert_allclose(refined.residuals, alone.residuals, atol=1e-5)
    assert refined.result.converged


def test_a_constrained_optimum_is_what_scipy_finds_without_the_constraint(calibration, poses):
    """A box at a known place has three unknown lengths: least squares over these three."""
    pixels = clicks(calibration, poses)

    def residuals(size):
        shape = np.sign(BOX) * size
        return np.ravel(np.asarray(calibration.project(poses, shape)[0]) - pixels) / SIGMA

    best = least_squares(residuals, SIZE, x_scale=1e-3, xtol=1e-14, ftol=1e-14)
    planes = [
        OnPlane((0, 2, 4, 6), (1.0, 0.0, 0.0)),
        OnPlane((0, 1, 4, 5), (0.0, 1.0, 0.0)),
        OnPlane((0, 1, 2, 3), (0.0, 0.0, 1.0)),
    ]
    edges = [EqualLength((0, 1 << k), pair) for k, pairs in enumerate(
        [((2, 3), (4, 5), (6, 7)), ((1, 3), (4, 6), (5, 7)), ((1, 5), (2, 6), (3, 7))]
    ) for pair in pairs]  # fmt: skip
    parallels = [Parallel((0, 1), (2, 3)), Parallel((0, 1), (4, 5)), Parallel((0, 1), (6, 7)),
                 Parallel((0, 2), (1, 3)), Parallel((0, 4), (1, 5)), Parallel((0, 4), (2, 6)),
                 Parallel((0, 2), (4, 6))]  # fmt: skip
    refined = refine(None, observed(calibration, poses, pixels), planes + parallels + edges)
    assert refined.result.converged
    np.testing.assert_allclose(refined.points, np.sign(BOX) * best.x, atol=2e-8)
    covariance = np.linalg.inv(best.jac.T @ best.jac)
    np.testing.assert_allclose(refined.picture_covariance[7], covariance, rtol=1e-3, atol=1e-14)


@pytest.mark.parametrize("sigma", [None, 1e-5])
def test_true_constraints_make_it_better_and_its_covariance_stays_true(calibration, poses, sigma):
    """Soft ones are drawn: the object is off by what their sigma says."""
    squares, plain = [], []
    for seed in range(30):
        rng = np.random.default_rng((seed, 1))
        height = 0.0 if sigma is None else sigma * rng.standard_normal()
        points = BOX + np.array([0.0, 0.0, height])
        pixels = clicks(calibration, poses, seed, points=points)
        known = [OnPlane((0,), sigma=sigma), OnPlane((5,), offset=0.01, sigma=None)]
        known = known[:1] if sigma else [*known, KnownLength((0, 1), SIZE[0])]
        refined = refine(None, observed(calibration, poses, pixels), known)
        rows = refined.joint_covariance([0, 1])
        error = (refined.points - points)[:2].ravel()
        values, vectors = np.linalg.eigh(rows)
        used = values > 1e-6 * values[-1]
        squares.append(np.sum((vectors.T @ error)[used] ** 2 / values[used]))
        plain.append(refined.rms)
    statistic = mean_nees(np.array(squares), int(used.sum()))
    assert statistic.is_consistent, statistic


def test_chi_square_of_true_constraints_is_chi_square(calibration, poses):
    p_values, costs = [], []
    for seed in range(30):
        pixels = clicks(calibration, poses, seed)
        known = [SamePlane(FACES[1]), RightAngle((4, 5), (4, 6)), KnownLength((0, 4), 0.01)]
        refined = refine(None, observed(calibration, poses, pixels), known)
        assert [verdict.degrees_of_freedom for verdict in refined.verdicts] == [1, 1, 1]
        p_values.append(refined.constraints_p_value)
        costs.append(refined.verdicts[2].cost)
    assert kstest(p_values, "uniform").pvalue > 0.01
    assert kstest(costs, chi2(1).cdf).pvalue > 0.01


def test_the_cost_is_what_releasing_the_constraint_saves(calibration, poses):
    pixels = clicks(calibration, poses)
    known = [SamePlane(FACES[1]), RightAngle((4, 5), (4, 6)), KnownLength((0, 4), 0.0105)]
    refined = refine(None, observed(calibration, poses, pixels), known)

    def chi_square(constraints):
        free = refine(None, observed(calibration, poses, pixels), constraints)
        return np.nansum(free.residuals**2) / SIGMA**2

    whole = chi_square(known)
    for k, verdict in enumerate(refined.verdicts):
        saved = whole - chi_square(known[:k] + known[k + 1 :])
        assert verdict.cost == pytest.approx(saved, rel=0.05, abs=0.05)


def test_a_constraint_that_contradicts_the_pictures_is_named(calibration, poses):
    pixels = clicks(calibration, poses)
    good = refine(None, observed(calibration, poses, pixels), TRUE)
    assert not good.contradictions
    assert good.result.converged
    assert np.abs(np.concatenate([verdict.residuals for verdict in good.verdicts])).max() < 1e-7
    wrong = KnownLength((0, 1), SIZE[0] + 5e-4)
    refined = refine(None, observed(calibration, poses, pixels), [*TRUE, wrong])
    assert refined.contradictions[0].constraint == wrong
    assert refined.contradictions[0].p_value < 1e-6
    assert "costs" in str(refined.contradictions[0])


def test_exact_constraints_that_contradict_one_another_are_named(calibration, poses):
    pixels = clicks(calibration, poses)
    known = [KnownLength((0, 1), SIZE[0]), KnownLength((0, 1), SIZE[0] + 1e-3)]
    refined = refine(None, observed(calibration, poses, pixels), known)
    assert {contradiction.constraint for contradiction in refined.contradictions} == set(known)
    assert "cannot hold together" in str(refined.contradictions[0])


def test_a_vertex_of_one_view_is_found_by_its_plane(calibration, poses):
    pixels = clicks(calibration, poses)
    visible = np.ones((5, 8), dtype=bool)
    visible[1:, 3] = False
    only = observed(calibration, poses, pixels, visible=visible)
    alone = refine(None, only)
    assert alone.status[3] == PointStatus.TOO_FEW_VIEWS
    assert np.isnan(alone.points[3]).all()
    assert alone.ok.sum() == 7
    refined = refine(None, only, [SamePlane(FACES[0])])
    assert refined.ok.all()
    error = refined.points[3] - BOX[3]
    assert error @ np.linalg.solve(refined.picture_covariance[3], error) < chi2(3).ppf(0.999)
    assert np.linalg.norm(error) < 1e-3
    assert refined.joint_covariance([3]).shape == (3, 3)
    np.testing.assert_allclose(refined.joint_covariance([3]), refined.picture_covariance[3])
    hidden = visible.copy()
    hidden[:, 3] = False
    with pytest.raises(ValueError, match="point 3 needs a start"):
        refine(None, observed(calibration, poses, pixels, visible=hidden))


def test_lines_and_points_are_bound(calibration, poses):
    ends = BOX[[[0, 1], [4, 5]]]
    segments = np.array(calibration.project(poses, ends.reshape(-1, 3))[0]).reshape(5, 2, 2, 2)
    segments += SIGMA * np.random.default_rng(5).standard_normal(segments.shape)
    seen = observed(
        calibration, poses, clicks(calibration, poses), segments=segments, segment_sigma=SIGMA
    )
    free = refine(None, seen)
    bound = refine(
        None, seen, [Parallel(LineIndex(0), LineIndex(1)), Parallel((2, 3), LineIndex(0))]
    )
    assert bound.result.converged
    turn = np.cross(bound.lines.directions[0], bound.lines.directions[1])
    assert np.linalg.norm(turn) < 1e-8
    assert np.trace(bound.line_covariance[1]) < np.trace(free.line_covariance[1])
    assert not bound.contradictions


@pytest.mark.parametrize("free", ["poses", "calibration"])
def test_free_poses_improve_the_points_and_the_covariance_stays_true(
    calibration, poses, uncertain, free
):
    bound, noise = uncertain
    squares, errors = [], {free: [], "nothing": []}
    for seed in range(15):
        rng = np.random.default_rng((seed, 2))
        reported = reported_poses(
            SE3.from_matrix(jnp.asarray(poses)), rng, noise.translation, noise.rotation
        )
        # The calibration is exact here; only the poses err.
        seen = observed(calibration, host_matrices(reported), clicks(calibration, poses, seed))
        estimate = bound if free == "calibration" else None
        for kind in errors:
            refined = refine(None, seen, free=kind, noise=noise, covariance=estimate)
            errors[kind].append(refined.points - BOX)
            if kind == free and free == "poses":
                squares.append(
                    errors[kind][-1].ravel()
                    @ np.linalg.solve(refined.joint_covariance(), errors[kind][-1].ravel())
                )
    shapes = {k: np.array(v) - np.mean(v, axis=1, keepdims=True) for k, v in errors.items()}
    assert np.std(shapes[free]) < 0.95 * np.std(shapes["nothing"])
    if squares:
        assert mean_nees(np.array(squares), 24).is_consistent


def test_the_held_calibration_moves_the_answer_as_another_fit_would(calibration, poses, uncertain):
    bound, noise = uncertain
    pixels = clicks(calibration, poses)
    alone = triangulate_points(
        calibration, poses, pixels, pixel_sigma=SIGMA, covariance=bound, noise=noise
    )
    refined = refine(None, observed(calibration, poses, pixels), covariance=bound, noise=noise)
    assert refined.calibration_names == alone.calibration_names
    np.testing.assert_allclose(refined.covariance(), alone.covariance(), rtol=1e-4)
    np.testing.assert_allclose(refined.joint_covariance(), alone.joint_covariance(), rtol=1e-3,
                               atol=1e-12)  # fmt: skip
    # A fifth of a millimetre of the camera's height is not the table's fault.
    lifted = BOX + np.array([0.0, 0.0, np.sqrt(alone.covariance()[0, 2, 2])])
    seen = observed(calibration, poses, clicks(calibration, poses, points=lifted))
    table = [OnPlane((0, 1, 2, 3))]
    assert refine(None, seen, table).contradictions
    assert not refine(None, seen, table, covariance=bound, noise=noise).contradictions


def test_bad_input_is_named(calibration, poses):
    seen = observed(calibration, poses, clicks(calibration, poses))
    with pytest.raises(ValueError, match="no vertex 9"):
        refine(None, seen, [KnownLength((0, 9), 0.1)])
    with pytest.raises(ValueError, match="same place"):
        refine(np.repeat(BOX[:1], 8, axis=0), seen, [KnownLength((0, 1), 0.1)])
    with pytest.raises(ValueError, match="start: expected"):
        refine(BOX[:4], seen)
    with pytest.raises(ValueError, match="covariance or noise"):
        refine(None, seen, free="poses")
    with pytest.raises(ValueError, match="expected 5 views"):
        refine(BOX, seen._replace(pixels=seen.pixels[:4]))


def test_a_robust_loss_resists_a_gross_error(calibration, poses):
    pixels = clicks(calibration, poses)
    pixels[3, :, 0] += 15.0
    plain, robust = (refine(None, observed(calibration, poses, pixels), loss=loss)
                     for loss in (None, GemanMcClure()))  # fmt: skip
    assert np.abs(robust.points - BOX).max() < 0.3 * np.abs(plain.points - BOX).max()


SOME_FACTS = [
    KnownLength((0, 1), 0.03),
    EqualLength((0, 1), (2, 3)),
    KnownLength((0, 4), 0.0101, sigma=1e-4),
    SamePlane((0, 1, 2, 3)),
]


def test_what_remains_without_a_click_is_what_a_refinement_without_it_leaves(calibration, poses):
    pixels = clicks(calibration, poses)
    pixels[3:] = np.nan
    pixels[1, 2] += [4.0, -3.0]

    def chi_square(clicked):
        refined = refine(None, observed(calibration, poses, clicked), SOME_FACTS)
        soft = refined.verdicts[2].residuals / 1e-4
        return np.nansum((refined.residuals / SIGMA) ** 2) + np.sum(soft**2), refined.points

    _, points = chi_square(pixels)
    # With an agreement of zero every click is a suspect.
    suspects = suspect_clicks(
        calibration, poses, pixels, points, SOME_FACTS, pixel_sigma=SIGMA, agreement=0.0
    )
    assert len(suspects) == 24
    for click in (*suspects[:2], suspects[-1]):
        rest = pixels.copy()
        rest[click.view, click.point] = np.nan
        assert click.chi_square == pytest.approx(chi_square(rest)[0], rel=0.03)
    # 46 coordinates and 4 facts (four points in one plane are one), 24 unknown.
    assert suspects[0].degrees_of_freedom == 46 - 24 + 4
    suspects = suspect_clicks(calibration, poses, pixels, points, SOME_FACTS, pixel_sigma=SIGMA)
    assert [(click.view, click.point) for click in suspects] == [(1, 2)]


def test_robot_noise_is_no_reason_to_suspect_a_click(calibration, poses, uncertain):
    """It moves all clicks of a view together, so what remains is chi-square all the same."""
    _, noise = uncertain
    rest = []
    for seed in range(8):
        reported = reported_poses(
            SE3.from_matrix(jnp.asarray(poses)),
            np.random.default_rng((seed, 3)),
            noise.translation,
            noise.rotation,
        )
        suspects = suspect_clicks(
            calibration,
            host_matrices(reported),
            clicks(calibration, poses, seed),
            BOX,
            SOME_FACTS[:2],
            noise=noise,
            pixel_sigma=SIGMA,
            agreement=0.0,
        )
        rest += [click.chi_square / click.degrees_of_freedom for click in suspects[-1:]]
    # 8 means of 56 squares each: a standard deviation of 0.07.
    assert 0.8 < np.mean(rest) < 1.2
