"""A script at the editor makes the model that a person would."""

import json

import cv2
import numpy as np
import pytest

import smartview_jax as sv
from smartview_jax.geometry import host_matrices
from smartview_jax.picking import SeenObject, model_by_clicks
from smartview_jax.picking.demo import _visible_vertices
from smartview_jax.robots import Command
from smartview_jax.simulation import Polyhedron, paper_calibration, stepped_block


@pytest.fixture(scope="module")
def sample():
    folder = sv.io.object_sample_folder()
    views = sv.io.load_object_views(folder / "object")
    truth = json.loads((folder / "truth.json").read_text())
    return views, np.array(truth["vertices"]), truth["faces"]


def clicked(sample, path, sees=True):
    views, vertices, faces = sample
    calibration = paper_calibration()
    seen = np.asarray(calibration.project(views.base_from_tool, vertices)[0])
    centres = np.linalg.inv(host_matrices(calibration.camera_from_world(views.base_from_tool)))
    solid = Polyhedron(vertices, tuple(map(tuple, faces)))
    visible = np.stack([_visible_vertices(solid, centre) for centre in centres[:, :3, 3]])
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in views.paths]
    command = Command(views.base_from_tool)
    shown = SeenObject(seen, visible & sees, faces, "block")
    return model_by_clicks(calibration, None, command, pictures, shown, path)


def test_the_clicked_model_has_the_true_dimensions(sample, tmp_path):
    model = clicked(sample, tmp_path / "block.json")
    _, vertices, _ = sample
    distances = np.linalg.norm(model.vertices[:, None] - vertices, axis=2).min(axis=1)
    assert len(model.vertices) >= 8
    assert len(model.faces) >= 2
    # Millimetres of an object of 26 mm, seen at 0.2 m by 10 px a millimetre.
    assert np.median(distances) < 3e-4
    assert model.name == "block"
    saved = sv.io.load_object_model(tmp_path / "block.json")
    np.testing.assert_array_equal(saved.vertices, model.vertices)
    np.testing.assert_allclose(saved.symmetry.rotations, model.symmetry.rotations)


def test_a_script_that_sees_nothing_says_so(sample, tmp_path):
    with pytest.raises(ValueError, match="0 vertices were clicked, no face is complete"):
        clicked(sample, tmp_path / "none.json", sees=False)


def test_a_face_is_seen_whichever_corner_it_begins_at():
    """At a corner that points inwards three corners turn the other way."""
    solid, centre = stepped_block(0.06), np.array([0.3, 0.2, 0.4])
    expected = _visible_vertices(solid, centre)
    assert 0 < expected.sum() < len(expected)
    for first in range(1, 6):
        faces = tuple(tuple(np.roll(loop, -first).tolist()) for loop in solid.faces)
        assert np.array_equal(_visible_vertices(solid._replace(faces=faces), centre), expected)
