import itertools

import cv2
import equinox as eqx
import jax
import numpy as np
import pytest
from matplotlib.quiver import Quiver
from standard_scene import POINTS, VIEWS

from smartview_jax import Dataset, plots
from smartview_jax.evaluation import ReprojectionErrors, reprojection_errors
from smartview_jax.simulation import paper_calibration, random_scene
from smartview_jax.targets import CircleGrid, StackedTarget


@pytest.fixture(scope="module")
def scene():
    return random_scene(1, VIEWS, POINTS, outlier_fraction=0.05)


@pytest.fixture(scope="module")
def errors(scene):
    fitted = reprojection_errors(scene.calibration, scene.data)
    return {"staged": fitted, "joint": fitted}


def drawn(axes, label):
    (line,) = (line for line in axes.lines if line.get_label() == label)
    return np.stack(line.get_data(), axis=-1)


def test_cross_bars_stand_where_the_calibration_predicts(scene):
    picture = np.zeros((480, 640), np.uint8)
    (axes,) = plots.prediction_overlay(scene.data, 2, picture, scene.calibration).axes
    predicted, _ = scene.calibration.project(scene.data.base_from_tool, scene.data.points)
    np.testing.assert_array_equal(drawn(axes, "predicted"), predicted[2])
    seen = np.asarray(scene.data.visible[2])
    np.testing.assert_array_equal(drawn(axes, "measured"), np.asarray(scene.data.pixels[2])[seen])
    # As a picture is looked at: v grows downwards.
    assert axes.get_ylim()[0] > axes.get_ylim()[1]


def test_of_a_board_at_several_heights_only_the_one_in_the_picture_is_drawn():
    target = StackedTarget(CircleGrid(3, 3, 0.01), (0.0, 0.01))
    data = random_scene(1, views=3, points=target.points).data
    object.__setattr__(data, "target", target)
    (axes,) = plots.prediction_overlay(
        data, 0, np.zeros((480, 640), np.uint8), paper_calibration()
    ).axes
    assert len(drawn(axes, "predicted")) == 9
    # The first height was not detected: the picture shows the second one.
    upper = eqx.tree_at(lambda d: d.visible, data, data.visible.at[0, :9].set(False))
    (axes,) = plots.prediction_overlay(
        upper, 0, np.zeros((480, 640), np.uint8), paper_calibration()
    ).axes
    np.testing.assert_array_equal(drawn(axes, "measured"), np.asarray(data.pixels[0, 9:]))
    # Nothing was found in any picture of the view.
    absent = eqx.tree_at(lambda d: d.visible, data, data.visible.at[0].set(False))
    (axes,) = plots.prediction_overlay(
        absent, 0, np.zeros((480, 640), np.uint8), paper_calibration()
    ).axes
    assert len(drawn(axes, "measured")) == 0
    assert axes.get_xlim() == (-0.5, 639.5)


def test_the_histogram_counts_every_point_below_its_limit(errors):
    (axes,) = plots.error_histogram(errors).axes
    values = errors["staged"].values
    bars = sum(bar.get_height() for bar in axes.containers[0])
    assert bars == np.sum(values <= np.percentile(values, 99.5))
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["staged", "joint"]
    assert axes.lines[0].get_xdata()[0] == pytest.approx(values.mean())


def test_arrows_point_from_the_prediction_to_the_measurement(scene):
    predicted, _ = scene.calibration.project(scene.data.base_from_tool, scene.data.points)
    residuals = np.asarray(scene.data.pixels - predicted)
    axes = plots.residual_vectors(scene.data, residuals).axes[0]
    (arrows,) = (child for child in axes.get_children() if isinstance(child, Quiver))
    seen = np.asarray(scene.data.visible)
    gain = float(axes.get_title().split()[2])
    for where, vector in zip(arrows.XY, np.stack([arrows.U, arrows.V], axis=-1), strict=True):
        nearest = np.argmin(np.linalg.norm(np.asarray(scene.data.pixels)[seen] - where, axis=1))
        # The title's gain is rounded.
        np.testing.assert_allclose(vector, gain * residuals[seen][nearest], rtol=0.5 / gain + 1e-9)


def test_one_point_far_off_leaves_the_others_their_colours(scene):
    residuals = np.ones(scene.data.pixels.shape)
    view, point = np.argwhere(scene.data.visible)[0]
    residuals[view, point] = 100.0
    axes = plots.residual_vectors(scene.data, residuals).axes[0]
    (arrows,) = (child for child in axes.get_children() if isinstance(child, Quiver))
    assert arrows.get_clim() == pytest.approx((0.0, np.sqrt(2.0)))


def test_bars_are_the_rms_of_each_view(scene, errors):
    (axes,) = plots.view_errors(scene.data, errors).axes
    heights = [bar.get_height() for bar in axes.containers[1]]
    np.testing.assert_allclose(heights, errors["joint"].rms_per_view)
    assert [tick.get_text() for tick in axes.get_xticklabels()] == list(scene.data.view_ids)


def test_cameras_stand_where_the_chain_puts_them(scene):
    (axes,) = plots.camera_poses_3d(scene.data, scene.calibration).axes
    poses = scene.calibration.camera_from_world(scene.data.base_from_tool)
    centres = poses.inverse().translation()
    labels = [text for text in axes.texts if text.get_text().strip() in scene.data.view_ids]
    places = np.array([text.get_position_3d() for text in labels])
    np.testing.assert_allclose(places, centres, atol=1e-12)


def test_the_band_is_that_of_the_draws_and_what_is_open_is_not_drawn():
    chosen = np.array([np.inf, 2.0, 1.0])
    drawn = np.stack([np.array([np.inf, 4.0 + k, 3.0 + k]) for k in range(21)])
    (axes,) = plots.error_by_views(chosen, drawn, "mm").axes
    np.testing.assert_array_equal(axes.lines[1].get_data(), [[2, 3], [2.0, 1.0]])
    np.testing.assert_array_equal(axes.lines[0].get_ydata(), [14.0, 13.0])
    edge = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert (edge.min(), edge.max()) == (4.0, 23.0)
    assert "mm" in axes.get_ylabel()


def test_names_of_many_views_do_not_overlap():
    poses = np.broadcast_to(np.eye(4), (130, 4, 4))
    data = Dataset.from_arrays(np.zeros((1, 3)), np.zeros((130, 1, 2)), poses, (640, 480))
    errors = {"joint": ReprojectionErrors(*np.ones((2, 130, 1)))}
    figure = plots.view_errors(data, errors)
    figure.canvas.draw()
    boxes = [tick.get_window_extent() for tick in figure.axes[0].get_xticklabels()]
    assert len(boxes) > 30
    assert all(a.x1 <= b.x0 for a, b in itertools.pairwise(boxes))


def test_a_figure_shows_itself_in_a_notebook(errors):
    picture = cv2.imdecode(
        np.frombuffer(plots.error_histogram(errors)._repr_png_(), np.uint8), cv2.IMREAD_COLOR
    )
    assert picture.shape == (363, 517, 3)
    assert np.unique(picture.reshape(-1, 3), axis=0).shape[0] > 50


def test_nothing_to_draw_is_said(scene, errors):
    nothing = reprojection_errors(scene.calibration, scene.data)
    nothing = nothing._replace(px=np.full_like(nothing.px, np.inf))
    with pytest.raises(ValueError, match="no point was predicted"):
        plots.error_histogram({"joint": nothing})
    with pytest.raises(ValueError, match="none is finite"):
        plots.residual_vectors(scene.data, np.full(scene.data.pixels.shape, np.nan))


def test_the_frames_stand_where_the_chain_puts_them(scene):
    (axes,) = plots.frames_diagram(scene.data, scene.calibration, view=3).axes
    places = {text.get_text().strip(): text.get_position_3d() for text in axes.texts}
    pose = jax.tree.map(lambda leaf: leaf[3], scene.data.base_from_tool)
    base_from_camera = pose @ scene.calibration.camera_from_tool.inverse()
    for name, expected in (
        ("base", np.zeros(3)),
        ("tool", pose.translation()),
        ("camera", base_from_camera.translation()),
        ("world (target)", scene.calibration.base_from_world.translation()),
    ):
        np.testing.assert_allclose(places[name], 1e3 * np.asarray(expected), atol=1e-9)


def test_the_steps_are_drawn_in_their_order():
    (axes,) = plots.steps_diagram().axes
    boxes = [text for text in axes.texts if text.get_text()]
    heights = [text.get_position()[1] for text in boxes]
    assert heights == sorted(heights, reverse=True)
    assert [t.get_text()[:6] for t in boxes[1:4]] == ["Step 1", "Step 2", "Step 3"]
