"""A board that was raised between two rounds of the robot: every picture has a pose of its own."""

import shutil

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

import smartview_jax as sv
from smartview_jax.geometry import five_viewpoints
from smartview_jax.io.csv_tables import read_table, write_table
from smartview_jax.io.dataset_folder import write_dataset_folder
from smartview_jax.simulation import paper_calibration
from smartview_jax.targets import CircleGrid, StackedTarget

TARGET = StackedTarget(CircleGrid(5, 6, 0.006, origin_mark=True), (0.0, 0.012))
POINTS = len(TARGET.board.points)
ROUND = 5


def all_heights(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    return [row | {"height": str(k // ROUND)} for k, row in enumerate(rows)]


def rewrite(folder, change):
    """Write the table of poses again with other rows."""
    rows = change(read_table(folder / "poses.csv", ()).rows)
    write_table(folder / "poses.csv", list(rows[0]), [list(row.values()) for row in rows])


@pytest.fixture(scope="module")
def poses():
    """Poses of two rounds: in the second one the robot stands up to some millimetres elsewhere."""
    rng = np.random.default_rng(3)
    aims = np.broadcast_to(TARGET.points.mean(axis=0), (ROUND, 3))
    viewpoints = five_viewpoints(aims, 0.25, np.linspace(-0.8, 0.8, ROUND))
    first = paper_calibration().command_for(viewpoints)
    moved = first @ SE3.exp(jnp.asarray(rng.normal(scale=2e-3, size=(ROUND, 6))))
    return SE3(jnp.concatenate([first.wxyz_xyz, moved.wxyz_xyz]))


def drawn(outlines):
    """A picture of dark circles, whose pixels are means of 4 x 4 smaller ones."""
    fine = np.full((4 * 480, 4 * 640), 230, np.uint8)
    for outline in outlines:
        # The middle of a pixel is at half of its width.
        place = 4.0 * (outline + 0.5) - 0.5
        cv2.fillPoly(fine, [np.rint(16 * place).astype(np.int32)], 30, cv2.LINE_8, shift=4)
    return cv2.GaussianBlur(cv2.resize(fine, (640, 480), interpolation=cv2.INTER_AREA), (0, 0), 0.8)


def circle_outlines(poses, height):
    """Pixels of every circle's rim, where the camera sees the board at one of its heights."""
    centres = TARGET.points.reshape(2, POINTS, 3)[height]
    radii = np.where(np.arange(POINTS) == 0, 0.0027, 0.0018)
    around = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    rim = np.stack([np.cos(around), np.sin(around), np.zeros(32)], axis=1)
    points = centres[:, None] + radii[:, None, None] * rim
    pixels, _ = paper_calibration().project(poses, points.reshape(-1, 3))
    return np.asarray(pixels).reshape(-1, POINTS, 32, 2)


@pytest.fixture(scope="module")
def two_rounds(tmp_path_factory, poses):
    folder = tmp_path_factory.mktemp("two_rounds")
    (folder / "images").mkdir()
    views = [f"{'ab'[k // ROUND]}{k % ROUND}" for k in range(2 * ROUND)]
    outlines = [
        outline
        for height in (0, 1)
        for outline in circle_outlines(SE3(poses.wxyz_xyz[ROUND * height :][:ROUND]), height)
    ]
    for view, rims in zip(views, outlines, strict=True):
        assert cv2.imwrite(str(folder / "images" / f"{view}.png"), drawn(rims))
    pictures = {"pictures": {"pattern": "images/{view}.png"}}
    write_dataset_folder(folder, views, poses, (640, 480), TARGET, "eye_in_hand", pictures)
    rewrite(folder, all_heights)
    return folder


@pytest.fixture
def copied(two_rounds, tmp_path):
    return shutil.copytree(two_rounds, tmp_path / "copied")


def test_every_picture_shows_the_board_at_its_own_height(two_rounds, poses):
    data = sv.load_dataset(two_rounds)
    visible = np.asarray(data.visible).reshape(-1, 2, POINTS)
    expected = np.zeros((2 * ROUND, 2), dtype=bool)
    expected[:ROUND, 0] = expected[ROUND:, 1] = True
    np.testing.assert_array_equal(visible, np.broadcast_to(expected[..., None], visible.shape))
    # The truth projects to where the circles were found: no height is taken for the other.
    predicted, _ = paper_calibration().project(poses, data.points)
    seen = np.asarray(data.visible)
    assert np.abs(np.asarray(predicted - data.pixels))[seen].max() < 0.5


def test_the_camera_is_found_from_both_rounds(two_rounds):
    data = sv.load_dataset(two_rounds)
    fit = sv.fit_staged(data, "radial")
    assert fit.result.converged
    truth = paper_calibration()
    np.testing.assert_allclose(fit.calibration.camera.alpha_u, truth.camera.alpha_u, rtol=5e-3)
    shift = fit.calibration.camera_from_tool.translation() - truth.camera_from_tool.translation()
    assert float(np.linalg.norm(shift)) < 2e-3


def test_kept_detections_are_of_the_heights_that_the_table_states(copied):
    before = sv.load_dataset(copied)
    # The other height in each row: the same pictures, and the cache must not be used.
    rewrite(copied, lambda rows: [row | {"height": str(1 - int(row["height"]))} for row in rows])
    after = sv.load_dataset(copied)
    np.testing.assert_array_equal(after.visible[0, POINTS:], before.visible[0, :POINTS])
    assert not np.asarray(after.visible[0, :POINTS]).any()


def test_the_editor_takes_the_only_picture_of_a_view(two_rounds):
    loaded = sv.io.load_view_pictures(two_rounds)
    assert [path.name for path in loaded.pictures] == [f"{view}.png" for view in loaded.view_ids]


@pytest.mark.parametrize("height", ["2", "-1", "0.012", ""])
def test_a_height_that_the_target_does_not_have_is_named(copied, height):
    rewrite(copied, lambda rows: [rows[0] | {"height": height}, *rows[1:]])
    with pytest.raises(ValueError, match=rf"poses.csv: view a0: height is '{height}'; expected"):
        sv.load_dataset(copied)


def test_without_the_column_the_message_says_what_is_missing(copied):
    rewrite(copied, lambda rows: [{k: v for k, v in row.items() if k != "height"} for row in rows])
    with pytest.raises(ValueError, match=r"or a column height in poses\.csv"):
        sv.load_dataset(copied)
