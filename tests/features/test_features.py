"""Features of rendered solids against the truth, and of real pictures against reference corners.

`python tests/features/test_features.py` renders the pictures in `data` again.
"""

import csv
import json
from pathlib import Path

import cv2
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from shared_data import shared_data

import smartview_jax as sv
from smartview_jax import features
from smartview_jax.simulation import (
    SolidScene,
    Surface,
    look_at_from_above,
    matt,
    paper_calibration,
    random_polyhedron,
    render_solids,
)

CALIBRATION = eqx.tree_at(lambda c: c.camera.lens.k1, paper_calibration(), jnp.asarray(0.7))
"""The paper's camera with the strong distortion of its Table 1: an edge bends by up to 5 px."""

FOCAL_LENGTH = 2133.0
CLEARANCE = 6.0
"""Distance from other edges, px, within which a blurred edge is biased whatever is done."""


PICTURES = [Path(__file__).parent / "data" / f"solid_{k}.png" for k in range(8)]
"""Of solids of random shape at random poses, without noise."""


def solids():
    """Each solid, and the command of its view."""
    rng = np.random.default_rng(1)
    for _ in PICTURES:
        solid = random_polyhedron(rng, int(rng.choice([8, 10, 12])), 0.012)
        camera_from_world = look_at_from_above(
            np.array([0.0, 0.0, 0.009]), 0.2, rng.uniform(0.1, 0.5), *rng.uniform(-3.0, 3.0, 2)
        )
        yield solid, CALIBRATION.command_for(camera_from_world)


def render():
    """Write the pictures."""
    for path, (solid, pose) in zip(PICTURES, solids(), strict=True):
        surfaces = Surface.of_plane(0.3, matt(0.25)), Surface.of_polyhedron(solid, matt(0.8))
        path.parent.mkdir(exist_ok=True)
        picture = render_solids(CALIBRATION, pose, SolidScene(surfaces), noise=0.0, samples=16)
        cv2.imwrite(str(path), picture)


def views(noise=2.0):
    """Features of the pictures with noise, projected vertices, vertices in the camera, solids."""
    for seed, (path, (solid, pose)) in enumerate(zip(PICTURES, solids(), strict=True)):
        clean = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        rng = np.random.default_rng(seed)
        noisy = np.rint(clean + noise * rng.standard_normal(clean.shape))
        in_picture = features.find(np.clip(noisy, 0, 255).astype(np.uint8), CALIBRATION.camera)
        in_camera = np.asarray(CALIBRATION.points_in_camera(pose, solid.vertices))
        yield in_picture, np.asarray(CALIBRATION.project(pose, solid.vertices)[0]), in_camera, solid


@pytest.fixture(scope="module")
def rendered():
    return list(views())


def distance_to_segment(points, a, b):
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(points - a - along[..., None] * (b - a), axis=-1)


def is_clear(vertex, pixels, solid):
    """No edge of others near a vertex, and no flat angle between its own."""
    own = [e for e in solid.edges if vertex in e]
    others = [e for e in solid.edges if vertex not in e]
    gaps = [distance_to_segment(pixels[vertex], *pixels[e]) for e in others]
    directions = np.array([pixels[e[e != vertex][0]] - pixels[vertex] for e in own])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    cosines = (directions @ directions.T)[np.triu_indices(len(own), 1)]
    return min(gaps) > CLEARANCE and cosines.max() < np.cos(np.deg2rad(25.0))


@pytest.fixture(scope="module")
def corner_errors(rendered):
    """Errors of corners of segments at clear vertices, and their whitened squares."""
    errors, nees = [], []
    for in_picture, pixels, _, solid in rendered:
        joined = in_picture.corner_segments[:, 1] >= 0
        for vertex in range(len(pixels)):
            distance = np.linalg.norm(in_picture.corners[joined] - pixels[vertex], axis=1)
            k = int(np.argmin(distance))
            if distance[k] < 3.0 and is_clear(vertex, pixels, solid):
                error = in_picture.corners[joined][k] - pixels[vertex]
                errors.append(error)
                covariance = in_picture.corner_covariances[joined][k]
                nees.append(error @ np.linalg.solve(covariance, error))
    return np.array(errors), np.array(nees)


def test_corners_have_no_bias_and_errors_of_hundredths_of_a_pixel(corner_errors):
    errors, _ = corner_errors
    assert len(errors) >= 25
    assert np.abs(errors.mean(axis=0)).max() < 0.05
    assert np.median(np.linalg.norm(errors, axis=1)) < 0.08


def test_covariances_of_corners_are_honest(corner_errors):
    """Of two-dimensional errors: the median of chi-square is 1.39, and 5.99 is its 95 % point."""
    _, nees = corner_errors
    assert 0.4 < np.median(nees) < 2.0
    assert np.mean(nees < 5.99) > 0.85


def test_lines_are_the_planes_through_the_edges(rendered):
    whitened, errors = [], []
    for in_picture, pixels, in_camera, solid in rendered:
        for a, b in solid.edges:
            normal = np.cross(in_camera[a], in_camera[b])
            normal /= np.linalg.norm(normal)
            length = np.linalg.norm(pixels[b] - pixels[a])
            clear = is_clear(a, pixels, solid) and is_clear(b, pixels, solid)
            ends = np.minimum(
                np.linalg.norm(in_picture.segments - pixels[a], axis=2).min(axis=1),
                np.linalg.norm(in_picture.segments - pixels[b], axis=2).min(axis=1),
            )
            sign = np.sign(in_picture.lines @ normal)[:, None]
            angle = np.linalg.norm(in_picture.lines * sign - normal, axis=1)
            k = int(np.argmin(angle))
            if not clear or length < 40.0 or ends[k] > 3.0 or angle[k] * FOCAL_LENGTH > 3.0:
                continue
            error = in_picture.lines[k] * sign[k] - normal
            values, vectors = np.linalg.eigh(in_picture.line_covariances[k])
            assert values[0] < 1e-6 * values[1]
            whitened.append(((vectors[:, 1:].T @ error) ** 2 / values[1:]).sum())
            middle = in_camera[a] + in_camera[b]
            errors.append(FOCAL_LENGTH * in_picture.lines[k] @ middle / np.linalg.norm(middle))
    assert len(errors) >= 20
    assert np.abs(np.mean(errors)) < 0.05
    assert np.sqrt(np.mean(np.square(errors))) < 0.06
    assert 0.3 < np.median(whitened) < 2.0


def test_ends_at_corners_are_the_corners(rendered):
    in_picture = rendered[0][0]
    joined = np.nonzero(in_picture.corner_segments[:, 0] >= 0)[0]
    for k in joined:
        ends = in_picture.segments[
            in_picture.corner_segments[k][in_picture.corner_segments[k] >= 0]
        ]
        assert np.linalg.norm(ends - in_picture.corners[k], axis=2).min() < 1e-9


def test_everything_is_finite_and_in_the_picture(rendered):
    for in_picture, *_ in rendered:
        for part in in_picture[:-1]:
            assert np.isfinite(part).all()
        assert ((in_picture.corners >= -0.5) & (in_picture.corners <= [639.5, 479.5])).all()
        np.testing.assert_allclose(np.linalg.norm(in_picture.lines, axis=1), 1.0)
        assert (np.linalg.eigvalsh(in_picture.corner_covariances) > 0.0).all()
        assert (np.linalg.eigvalsh(in_picture.end_covariances) > 0.0).all()


def test_the_lighter_side_is_to_the_left():
    picture = np.full((480, 640), 60, np.uint8)
    cv2.rectangle(picture, (200, 150), (400, 300), 180, -1)
    in_picture = features.find(picture, CALIBRATION.camera)
    assert len(in_picture.segments) == 4
    for a, b in in_picture.segments:
        d = (b - a) / np.linalg.norm(b - a)
        # To the left of the direction, in a picture whose v points down.
        left = 0.5 * (a + b) + 10.0 * np.array([d[1], -d[0]])
        u, v = np.rint(left).astype(int)
        assert picture[v, u] == 180


def test_a_dot_is_a_corner_of_the_gradient_and_a_colour_picture_is_accepted():
    picture = np.full((480, 640, 3), 60, np.uint8)
    picture[239:242, 319:322] = 255
    cv2.rectangle(picture, (100, 100), (180, 160), (0, 200, 0), -1)
    in_picture = features.find(picture, CALIBRATION.camera)
    gap = np.linalg.norm(in_picture.corners - [320.0, 240.0], axis=1)
    assert gap.min() < 0.3
    assert in_picture.corner_segments[np.argmin(gap), 0] == -1


def test_an_edge_map_has_thin_lines():
    picture = np.full((480, 640), 60, np.uint8)
    cv2.rectangle(picture, (200, 150), (400, 300), 180, -1)
    edges = features.edge_map(picture, CALIBRATION.camera)
    assert edges.shape == picture.shape
    canny = cv2.Canny(picture, 50, 100) > 0
    near = cv2.dilate(canny.astype(np.uint8), np.ones((3, 3))) > 0
    assert (edges & ~near).sum() == 0
    assert edges.sum() == pytest.approx(canny.sum(), rel=0.1)


def blank(level):
    return np.full((480, 640), level, np.uint8)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (np.zeros((0, 0), np.uint8), "found nothing"),
        (np.zeros((480, 640)), "found float64"),
        (np.zeros((480, 640, 4), np.uint8), r"found uint8 \(480, 640, 4\)"),
        (
            np.zeros((640, 480), np.uint8),
            "expected 640 x 480 px, the camera's size, found 480 x 640",
        ),
        (blank(100), "blank, its grey levels are between 100 and 100"),
        (blank(255), "over-exposed, 100% of its pixels are 255"),
        (blank(0), "under-exposed, 100% of its pixels are 0"),
    ],
)
def test_what_is_no_picture_of_the_camera_is_named(picture, message):
    with pytest.raises(ValueError, match=message):
        features.find(picture, CALIBRATION.camera)


def test_a_picture_without_straight_edges_has_no_segments():
    v, u = np.mgrid[:480, :640]
    picture = np.rint(120.0 + 60.0 * np.sin(u / 60.0) * np.sin(v / 50.0)).astype(np.uint8)
    in_picture = features.find(picture, CALIBRATION.camera)
    assert in_picture.segments.shape == (0, 2, 2)
    assert in_picture.line_covariances.shape == (0, 3, 3)


def reference_corners(name, views):
    """Camera, picture and reference corners of some views of a set with a plain pinhole camera."""
    folder = shared_data(name)
    content = json.loads((folder / "cameras.json").read_text())
    rows = list(csv.DictReader((folder / "corners.csv").read_text().splitlines()))
    for one in content["cameras"]:
        if one["view"] in views:
            k = np.array(one["K"])
            size = (content["width"], content["height"])
            camera = sv.Camera(k[0, 0], k[1, 1], k[0, 2], k[1, 2], sv.cameras.Pinhole(), size)
            picture = cv2.imdecode(np.frombuffer((folder / one["image"]).read_bytes(), np.uint8), 0)
            own = [row for row in rows if row["view"] == one["view"]]
            yield camera, picture, np.array([[float(row["u"]), float(row["v"])] for row in own])


@pytest.mark.parametrize(
    ("name", "views", "expected"),
    [
        ("visp_castle_simu", ["Image_0001", "Image_0025"], 0.9),
        ("vgg_house", ["000"], 0.9),
        ("visp_cube", ["image0045", "image0126"], 0.8),
    ],
)
def test_reference_corners_of_real_pictures_are_among_the_features(name, views, expected):
    hits = []
    for camera, picture, corners in reference_corners(name, views):
        in_picture = features.find(picture, camera)
        gap = np.linalg.norm(corners[:, None] - in_picture.corners, axis=2).min(axis=1)
        hits += list(gap < 1.5)
    assert np.mean(hits) >= expected


if __name__ == "__main__":
    render()
