import equinox as eqx
import jax
import numpy as np
import pytest
from linear_world import (
    GROUP,
    GROUP_FIXED,
    OTHERS,
    TRUTH,
    VIEWS,
    drawn,
    linearised,
    moved,
    some_held,
    with_held,
)
from scipy.optimize import minimize

from smartview_jax.runtime.modules import with_fields
from smartview_jax.variance import fisher_scoring
from smartview_jax.variance.fisher_information import fisher_information
from smartview_jax.variance.fisher_scoring import maximise, maximise_each
from smartview_jax.variance.likelihood import gradient, marginalise
from smartview_jax.variance.linearised_views import kinds_of
from smartview_jax.variance.standard_deviations import ROBOT_SIGMA_FLOOR, StandardDeviations

ALL_ACTIVE = np.ones(4, dtype=bool)


@pytest.mark.parametrize("sizes", [TRUTH, *OTHERS])
def test_information_is_that_of_the_textbook(world, sizes):
    """Half the trace of P dV P dV, on dense matrices (Searle, Casella and McCulloch, 6.6)."""
    inverse, design = world[:2]
    spread = np.concatenate(
        [
            np.asarray(sizes.field)[GROUP[GROUP >= 0]],
            np.tile(np.repeat([sizes.translation, sizes.rotation], 3), VIEWS),
        ]
    )
    kind = np.concatenate([GROUP[GROUP >= 0] + 3, np.tile(np.repeat([1, 2], 3), VIEWS)])
    fixed, random = design[:, GROUP_FIXED], design[:, ~GROUP_FIXED] * spread
    parts = [float(sizes.pixel) ** 2 * np.linalg.inv(inverse)]
    parts += [random[:, kind == k] @ random[:, kind == k].T for k in range(1, 5)]
    of_all = np.linalg.inv(sum(parts))
    fitted = of_all @ fixed
    P = of_all - fitted @ np.linalg.solve(fixed.T @ fitted, fitted.T)
    # By logarithms of deviations each part's derivative is twice the part.
    expected = [[0.5 * np.trace(P @ (2 * a) @ P @ (2 * b)) for b in parts] for a in parts]
    views = linearised(world, drawn(world, 1))
    found = fisher_information(views, marginalise(views, sizes), kinds_of(views, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)


def test_information_is_what_second_derivatives_are_on_average(world):
    """With some of the views' own numbers held, the information is still their mean."""

    def slopes_of_half(views, sizes):
        """By the logarithms of the sizes."""
        return 0.5 * sizes.vector * gradient(views, sizes, marginalise(views, sizes)).vector

    free, step, curved = some_held(), 1e-4, []
    for seed in range(60):
        views = with_held(linearised(world, drawn(world, seed, held=~free.ravel())), free)
        factors = np.expm1([step, -step])
        slopes = [[slopes_of_half(views, moved(TRUTH, k, f)) for f in factors] for k in range(5)]
        curved.append([(ahead - behind) / (2.0 * step) for ahead, behind in slopes])
    told = fisher_information(views, marginalise(views, TRUTH), kinds_of(views, 2))
    mean, error = np.mean(curved, axis=0), np.std(curved, axis=0) / np.sqrt(60)
    assert (np.abs(mean - told) < 4.0 * error + 1e-6).all()


@pytest.mark.parametrize("views", [1, 3, 20])
def test_information_is_that_of_dense_matrices(world, views):
    """Traces of products of the whole covariance and its precisions, for few views and for many."""
    whole = linearised(world, drawn(world, 2))
    matrix = eqx.tree_at(
        lambda m: (m.border, m.per_view),
        whole.matrix,
        (whole.matrix.border[:views], whole.matrix.per_view[:views]),
    )
    some = whole._replace(
        matrix=matrix,
        gradient=whole.gradient._replace(per_view=whole.gradient.per_view[:views]),
        offset_from_prior=whole.offset_from_prior._replace(
            per_view=whole.offset_from_prior.per_view[:views]
        ),
        per_view_free=whole.per_view_free[:views],
        statistic_count=6.0 * views,
    )
    own = np.tile(np.repeat([1, 2], 3), views)
    kind = np.concatenate([np.where(GROUP >= 0, GROUP + 3, -1), own])
    of_pixels = np.asarray(jax.tree.map(jax.numpy.asarray, matrix).as_matrix())
    precisions = [np.diag((kind == k) / TRUTH.vector[k] ** 2) for k in range(1, 5)]
    of_pixels = of_pixels / TRUTH.pixel**2
    covariance = np.linalg.inv(of_pixels + sum(precisions))
    products = [covariance @ part for part in (of_pixels, *precisions)]
    expected = np.array([[2.0 * np.trace(a @ b) for b in products] for a in products])
    counts = np.array([6.0 * views, *(np.count_nonzero(kind == k) for k in range(1, 5))])
    expected += 2.0 * np.diag(counts - 2.0 * np.trace(products, axis1=1, axis2=2))
    found = fisher_information(some, marginalise(some, TRUTH), kinds_of(some, 2))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


def test_the_sizes_found_are_true_on_average(world):
    start = StandardDeviations.from_vector(np.full(5, 0.1))
    found = [
        maximise(linearised(world, drawn(world, seed)), start, ALL_ACTIVE).sigmas.vector
        for seed in range(10, 40)
    ]
    variances = np.mean(np.square(found), axis=0)
    # The restricted likelihood's variances are unbiased; the field's rest on 2 and 3 draws each.
    np.testing.assert_allclose(variances[:3], np.square(TRUTH.vector[:3]), rtol=0.12)
    np.testing.assert_allclose(variances[3:], np.square(TRUTH.vector[3:]), rtol=0.8)


def test_the_search_ends_at_an_optimum(world):
    views = linearised(world, drawn(world, 6))
    starts = [StandardDeviations.from_vector(f * TRUTH.vector) for f in (1.0, 2.5, 6.0)]
    found = [maximise(views, start, ALL_ACTIVE) for start in starts]
    values = [one.deviance for one in found]
    np.testing.assert_allclose(values, min(values), atol=1e-2)
    for k in range(5):
        for share in (-0.03, 0.03):
            assert marginalise(views, moved(found[0].sigmas, k, share)).deviance > values[0]


def test_begun_where_it_ended_it_has_nothing_to_gain(world):
    """Also where sizes are as small as they can be: the last group's here, and the pixels'."""
    views = linearised(world, drawn(world, 6))
    views = eqx.tree_at(lambda v: v.white_sigma, views, 2.0 * TRUTH.pixel)
    active = np.array([True, True, True, False])
    found = maximise(views, TRUTH, active)
    assert float(found.deviance_decrease) > 1.0
    np.testing.assert_allclose(found.sigmas.pixel, views.white_sigma, rtol=1e-3)
    again = maximise(views, found.sigmas, active)
    assert abs(float(again.deviance_decrease)) < 1e-2
    assert int(again.steps) <= 2


def test_a_group_that_is_switched_off_stays_at_zero(world):
    views = linearised(world, drawn(world, 7))
    found, value = maximise(views, TRUTH, np.array([True, True, True, False]))[:2]
    assert float(found.field[1]) == pytest.approx(ROBOT_SIGMA_FLOOR)
    assert float(value) > float(maximise(views, TRUTH, ALL_ACTIVE).deviance)


def test_views_that_cannot_be_linearised_have_no_maximum(world):
    """A matrix that is not positive definite, and one that is no number: NaN, and no exception."""
    views = linearised(world, drawn(world, 7))
    for wrong in (-1.0, np.nan):
        broken = eqx.tree_at(lambda v: v.matrix.per_view, views, wrong * views.matrix.per_view)
        found = maximise(broken, TRUTH, ALL_ACTIVE)
        assert np.isnan(found.deviance)
        assert found.steps == 0


def test_views_without_a_common_parameter_have_standard_deviations(world):
    """All common parameters are held; the maximum is SciPy's."""
    views = linearised(world, drawn(world, 7))
    matrix, offset = views.matrix, views.offset_from_prior
    nothing = np.zeros(0)
    views = views._replace(
        matrix=with_fields(matrix, shared=np.zeros((0, 0)), border=matrix.border[..., :0]),
        gradient=views.gradient._replace(shared=nothing),
        offset_from_prior=offset._replace(shared=nothing),
        known_weight=nothing,
        group_index=np.zeros(0, dtype=int),
    )
    start = TRUTH._replace(field=nothing)

    def deviance_at(logs):
        return marginalise(views, StandardDeviations.from_vector(np.exp(logs))).deviance

    best = minimize(deviance_at, np.log(start.vector), method="Nelder-Mead")
    found = maximise(views, start, np.ones(2, dtype=bool))
    assert found.deviance == pytest.approx(best.fun, abs=1e-3)


def test_searches_step_together_as_far_as_their_arrays_are_small(world, monkeypatch):
    """The third of these searches runs alone, and ends where it does with the others."""
    views = linearised(world, drawn(world, 7))
    active = np.array(
        [[True, True, True, True], [True, True, False, False], [True, True, True, False]]
    )
    together = maximise_each(views, TRUTH, active)
    sizes, search = [], fisher_scoring._Search

    def recorded(views, start, active, prior):
        sizes.append(len(active))
        return search(views, start, active, prior)

    monkeypatch.setattr(fisher_scoring, "_Search", recorded)
    limit = 2.5 * np.asarray(views.matrix.border).nbytes
    monkeypatch.setattr(fisher_scoring, "MAX_TOGETHER_BYTES", limit)
    apart = maximise_each(views, TRUTH, active)
    assert sizes == [2, 1]
    for one, other in zip(together, apart, strict=True):
        assert one.steps == other.steps
        np.testing.assert_allclose(one.sigmas.vector, other.sigmas.vector, rtol=1e-9)


def test_searches_that_fit_few_errors_step_without_those_that_fit_many(world, monkeypatch):
    """What no search of a batch fits is left out of its arrays."""
    views = linearised(world, drawn(world, 7))
    few, many = [True, True, False, False], [True, True, True, True]
    columns, search = [], fisher_scoring._Search

    def recorded(views, start, active, prior):
        started = search(views, start, active, prior)
        columns.append((len(active), started._objective.views.matrix.border.shape[-1]))
        return started

    monkeypatch.setattr(fisher_scoring, "_Search", recorded)
    monkeypatch.setattr(fisher_scoring, "MAX_COLUMN_RATIO", 1.0)
    found = maximise_each(views, TRUTH, np.array([many, few, many]))
    assert columns == [(1, np.sum(GROUP < 0)), (2, len(GROUP))]
    # The results are in the order of the searches.
    assert found[0].deviance == found[2].deviance != found[1].deviance


def test_searches_that_step_together_end_where_scipy_does(world):
    """They hold different groups, and end after different numbers of steps."""
    views = linearised(world, drawn(world, 7))
    active = np.array(
        [[True, True, True, True], [True, True, False, False], [True, True, True, False]]
    )
    found = maximise_each(views, TRUTH, active)
    assert len({one.steps for one in found}) > 1
    for mask, one in zip(active, found, strict=True):
        held = (GROUP >= 0) & ~np.append(mask[2:], True)[GROUP]
        free, kept = np.append(True, mask), views.with_held(held)

        def deviance_at(logs, free=free, kept=kept):
            numbers = np.full(5, ROBOT_SIGMA_FLOOR)
            numbers[free] = np.exp(logs)
            return marginalise(kept, StandardDeviations.from_vector(numbers)).deviance

        best = minimize(deviance_at, np.log(TRUTH.vector[free]), method="Nelder-Mead")
        assert one.deviance == pytest.approx(best.fun, abs=1e-3)
        np.testing.assert_allclose(one.sigmas.vector[free], np.exp(best.x), rtol=0.05)
        np.testing.assert_allclose(one.sigmas.vector[~free], ROBOT_SIGMA_FLOOR)
