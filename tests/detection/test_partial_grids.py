import cv2
import numpy as np
import pytest

from smartview_jax.detection import detect
from smartview_jax.detection.circles import MAX_BLOBS_PER_CIRCLE, candidate_blobs
from smartview_jax.targets import CircleGrid

PLAIN = CircleGrid(8, 10, 0.006)
MARKED = CircleGrid(8, 10, 0.006, origin_mark=True)
SQUARE = CircleGrid(7, 7, 0.006, origin_mark=True)


def drawn(target, turn=25.0, mark=1.5):
    """A picture of a grid, turned and seen aslant, and where its circles are."""
    c, s = np.cos(np.deg2rad(turn)), np.sin(np.deg2rad(turn))
    flat = 45.0 * (target.points / target.spacing - target.points.mean(axis=0) / target.spacing)
    flat = flat[:, :2] @ np.array([[c, s], [-s, c]])
    H = np.array([[1.0, 0.05, 400.0], [-0.03, 1.0, 350.0], [2e-4, -1e-4, 1.0]])
    image = np.full((700, 800), 230, dtype=np.uint8)
    around = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    rim = np.stack([np.cos(around), np.sin(around)], axis=1)
    for k, centre in enumerate(flat):
        radius = 13.0 * (mark if target.origin_mark and k == 0 else 1.0)
        outline = cv2.perspectiveTransform((centre + radius * rim)[None], H)
        cv2.fillPoly(image, np.rint(16 * outline).astype(np.int32), 30, cv2.LINE_AA, shift=4)
    centres = cv2.perspectiveTransform(flat[None], H)[0]
    return cv2.GaussianBlur(image, (0, 0), 0.8), centres


def hidden(image, centres, which):
    """The picture with some circles painted over, and which are left."""
    image, left = image.copy(), np.ones(len(centres), dtype=bool)
    for k in which:
        cv2.circle(image, tuple(int(x) for x in np.rint(centres[k])), 26, 230, -1)
        left[k] = False
    return image, left


def assert_seen(actual, target, centres, left):
    """Every circle that is left, in one of the orders that look alike, within the bias."""
    assert actual.reason is None
    fits = [
        np.array_equal(actual.visible[order], left)
        and np.abs(actual.pixels[order][left] - centres[left]).max() < 0.3
        for order in target.symmetries
    ]
    assert any(fits)


@pytest.mark.parametrize("target", [PLAIN, MARKED], ids=["plain", "marked"])
@pytest.mark.parametrize("turn", [0.0, 110.0])
@pytest.mark.parametrize("which", [(79,), (9, 35, 36, 70)], ids=["corner", "four"])
def test_circles_that_are_hidden_do_not_lose_the_others(target, turn, which):
    image, centres = drawn(target, turn)
    image, left = hidden(image, centres, which)
    assert_seen(detect(image, target), target, centres, left)


def test_a_circle_cut_by_the_border_is_left_out_and_no_other():
    image, centres = drawn(PLAIN, 0.0)
    edge = int(np.floor(centres[:, 0].max()))
    left = edge - centres[:, 0] > 12.0
    assert left.sum() == 77
    detection = detect(np.ascontiguousarray(image[:, :edge]), PLAIN)
    assert_seen(detection, PLAIN, centres, left)


@pytest.mark.parametrize("target", [MARKED, SQUARE], ids=["8 x 10", "7 x 7"])
@pytest.mark.parametrize("turn", [0.0, 250.0])
def test_the_mark_tells_which_rows_and_columns_are_seen(target, turn):
    image, centres = drawn(target, turn)
    index = np.arange(target.rows * target.columns).reshape(target.rows, target.columns)
    image, left = hidden(image, centres, np.r_[index[-1], index[:, -2:].ravel()])
    assert_seen(detect(image, target), target, centres, left)


def test_a_hidden_mark_is_where_a_corner_is_missing():
    image, centres = drawn(MARKED)
    image, left = hidden(image, centres, [0])
    assert_seen(detect(image, MARKED), MARKED, centres, left)


@pytest.mark.parametrize(
    ("target", "why"),
    [
        (PLAIN, "the grid has no larger corner circle to show which"),
        (MARKED, "the larger corner circle was not found"),
    ],
    ids=["plain", "marked"],
)
def test_a_missing_row_that_nothing_tells_is_named(target, why):
    image, centres = drawn(target)
    image, _ = hidden(image, centres, range(10))
    detection = detect(image, target)
    assert not detection.visible.any()
    assert (
        "70 circles found, on 7 x 10 positions of 8 x 10: rows or columns are missing"
        in detection.reason
    )
    assert why in detection.reason


def test_another_grid_is_not_taken_for_this_one():
    image, _ = drawn(PLAIN)
    larger = detect(image, CircleGrid(6, 9, 0.006)).reason
    assert "is larger than 6 x 9" in larger
    assert "at least half of 400 are needed" in detect(image, CircleGrid(20, 20, 0.006)).reason


def noise_picture():
    noise = np.random.default_rng(0).normal(size=(480, 640))
    noise = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return np.clip(128 + 60 * noise / noise.std(), 0, 255).astype(np.uint8)


def test_a_picture_of_noise_is_not_searched_for_long(monkeypatch):
    """The finder takes the third power of the blobs as long: what it is handed is bounded."""
    handed, finder = [], cv2.findCirclesGrid

    def spied(points, *rest):
        handed.append(len(points))
        return finder(points, *rest)

    monkeypatch.setattr(cv2, "findCirclesGrid", spied)
    detection = detect(noise_picture(), CircleGrid(5, 5, 0.01))
    assert "25 expected; the picture has noise or texture" in detection.reason
    assert max(handed, default=0) <= MAX_BLOBS_PER_CIRCLE * 25


def test_among_too_many_blobs_those_of_like_size_are_kept():
    specks = [cv2.KeyPoint(50.0 + k % 500, 60.0 + k % 300, 3.0 + 0.01 * (k % 9)) for k in range(99)]
    circles = [cv2.KeyPoint(50.0 + 3.0 * k, 200.0, 12.0 + 0.2 * (k % 30)) for k in range(150)]
    assert candidate_blobs(specks + circles, 40, (480, 640)) == sorted(
        circles, key=lambda b: b.size
    )
    assert candidate_blobs(specks + circles, 20, (480, 640)) == []
    assert len(candidate_blobs(specks + circles, 80, (480, 640))) == 249
