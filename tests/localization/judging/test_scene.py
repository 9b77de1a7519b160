"""What an object takes from a scene, and what is as it was before."""

import numpy as np
import pytest
from drawn_edges import drawn, evidence
from placed_box import MODEL, POSE, placed

from smartview_jax.localization.judging.candidates import Prepared
from smartview_jax.localization.judging.scene import Scene

BEHIND = POSE.copy()
BEHIND[:3, 3] += [0.0, 0.0, -0.05]


@pytest.fixture(scope="module")
def prepared(few_samples):
    return Prepared.of(MODEL)


def explained(scene, pose, prepared):
    return float(scene.lines(pose, prepared.coarse).explained_px.sum())


def hidden(scene, pose, prepared):
    return float(scene.lines(pose, prepared.coarse).behind_px.sum())


def test_what_is_taken_is_free_in_the_untouched_scene(views, prepared):
    scene = Scene(views, evidence(drawn(MODEL, views, POSE, 0.05)), np.zeros((0, 3, 3)))
    before = explained(scene, POSE, prepared)
    assert hidden(scene, BEHIND, prepared) == 0.0
    claim = scene.claim(scene.lines(POSE, prepared.fine), prepared.coarse, POSE)
    assert explained(scene, POSE, prepared) == before
    scene.take(claim)
    assert explained(scene, POSE, prepared) < 0.01 * before
    # What the object hides is not held against others.
    assert hidden(scene, BEHIND, prepared) > 300.0
    restored = scene.untouched()
    assert explained(restored, POSE, prepared) == before
    assert hidden(restored, BEHIND, prepared) == 0.0
    # What is taken from one scene is not taken from the other.
    restored.take(claim)
    assert explained(scene.untouched(), POSE, prepared) == before


def test_a_scene_in_corrected_views_has_its_pictures_and_walls_and_nothing_is_taken(
    views, prepared
):
    wall = placed(np.array([[[-0.2, -0.2, 0.05], [0.4, -0.2, 0.05], [-0.2, 0.4, 0.05]]]))
    scene = Scene(views, evidence(drawn(MODEL, views, POSE, 0.05)), wall)
    turned = views._replace(camera_from_world=views.camera_from_world[::-1])
    scene.take(scene.claim(scene.lines(POSE, prepared.fine), prepared.coarse, POSE))
    again = scene.seen_by(turned)
    assert again.views is turned
    assert not again.has_claims
    walls = np.asarray(Scene(turned, scene.pictures, wall).lookup.nearest)
    np.testing.assert_array_equal(again.lookup.nearest, walls)
    assert walls.max() > 0.0


def test_claims_add_up_in_any_order(views, prepared):
    scene = Scene(views, evidence(drawn(MODEL, views, POSE, 0.05)), np.zeros((0, 3, 3)))
    first = scene.claim(scene.lines(POSE, prepared.fine))
    second = scene.claim(scene.lines(BEHIND, prepared.fine), prepared.coarse, BEHIND)
    one, other = scene.lookup_among([first, second]), scene.lookup_among([second, first])
    np.testing.assert_array_equal(one.cells, other.cells)
    np.testing.assert_array_equal(one.nearest, other.nearest)
    assert not np.array_equal(one.nearest, scene.lookup_among([first]).nearest)


def test_lines_know_how_far_points_err_alike_in_each_picture(views):
    pictures = [
        picture._replace(correlated_length=5.0 + k)
        for k, picture in enumerate(evidence(drawn(MODEL, views, POSE, 0.05)))
    ]
    lookup = Scene(views, pictures, np.zeros((0, 3, 3))).lookup
    lengths = np.asarray(lookup.correlated_lengths)[: len(pictures)]
    np.testing.assert_array_equal(lengths, 5.0 + np.arange(len(pictures)))
