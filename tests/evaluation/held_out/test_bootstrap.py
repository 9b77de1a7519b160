import numpy as np
import pytest
import scipy.stats

from smartview_jax.evaluation import HeldOutErrors, ReprojectionErrors, rms_interval


def deviations(views=12, points=30):
    """Views that differ far more than the points in them, some points not seen or predicted."""
    rng = np.random.default_rng(5)
    px = rng.gamma(2.0, 1.0, (views, 1)) * np.abs(rng.normal(size=(views, points)))
    px[rng.random(px.shape) < 0.2] = np.nan
    px[0, :3] = np.inf
    px[3] = np.nan
    return ReprojectionErrors(px, 1e-3 * px)


@pytest.mark.parametrize("level", [0.68, 0.95])
def test_the_interval_is_that_of_scipy_over_views(level):
    found = deviations()
    finite = [row[np.isfinite(row)] for row in found.px if np.isfinite(row).any()]
    squares = np.array([np.sum(row**2) for row in finite])
    counts = np.array([len(row) for row in finite])
    expected = scipy.stats.bootstrap(
        (squares, counts),
        lambda s, n, axis: np.sqrt(s.sum(axis=axis) / n.sum(axis=axis)),
        paired=True,
        method="percentile",
        confidence_level=level,
        n_resamples=20000,
        rng=np.random.default_rng(1),
    ).confidence_interval
    width = expected.high - expected.low
    found = rms_interval(found, level)
    np.testing.assert_allclose(found, [expected.low, expected.high], atol=0.04 * width)


def test_an_interval_of_views_is_wider_than_one_of_single_points():
    found = deviations()
    points = found.values
    drawn = np.random.default_rng(0).choice(points, (2000, points.size))
    low, high = np.quantile(np.sqrt(np.mean(drawn**2, axis=1)), [0.025, 0.975])
    interval = HeldOutErrors(found, (), ()).interval()
    assert interval.low < found.rms < interval.high
    assert interval.high - interval.low > 2.0 * (high - low)


def test_one_view_has_no_interval_and_a_level_is_a_share():
    one = ReprojectionErrors(np.ones((1, 3)), np.ones((1, 3)))
    assert np.isnan(rms_interval(one)).all()
    with pytest.raises(ValueError, match="between 0 and 1, found 95"):
        rms_interval(one, 95.0)
