"""What is predicted of a wireframe, against rays of Embree and a rendered picture.

`python tests/localization/test_prediction.py` renders the pictures in `data` again.
"""

from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from drawn_edges import IMAGE_SIZE, pinhole, predicted
from jaxlie import SE3
from scipy.spatial.transform import Rotation
from solids import box

import smartview_jax as sv
from smartview_jax import features
from smartview_jax.cameras import OpenCV5
from smartview_jax.geometry import host_exponentials, host_matrices, look_at
from smartview_jax.localization import Wireframe, pose_jacobians, predict_view
from smartview_jax.modeling import Face, ObjectModel, edges_of_faces
from smartview_jax.runtime.compilation import compiled
from smartview_jax.simulation import (
    SolidScene,
    Surface,
    matt,
    random_polyhedron,
    render_solids,
    roofed_block,
    stepped_block,
)

CAMERA = pinhole(600.0, 620.0)
BENT = sv.Camera(900.0, 900.0, 320.0, 240.0, OpenCV5(-0.2, 0.05, 0.0, 0.0, 0.0), IMAGE_SIZE)
PICTURES = [Path(__file__).parents[1] / "data" / f"stepped_{k}.png" for k in range(3)]


def model_of(solid):
    return ObjectModel(solid.vertices, solid.edges, tuple(Face(loop) for loop in solid.faces))


def ring():
    """A square plate with a square hole through it: two faces have holes, most of it is concave."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    rings = [
        np.column_stack([size * square, np.full(4, z)])
        for z in (0.0, 0.02)
        for size in (0.03, 0.015)
    ]
    faces = [
        Face((3, 2, 1, 0), holes=((4, 5, 6, 7),)),
        Face((8, 9, 10, 11), holes=((15, 14, 13, 12),)),
    ]
    for low, outward in ((0, True), (4, False)):
        for k in range(4):
            a, b = low + k, low + (k + 1) % 4
            side = (a, b, b + 8, a + 8)
            faces.append(Face(side if outward else side[::-1]))
    triangles = []
    for z, order in ((0, (1, 0)), (8, (0, 1))):
        for k in range(4):
            # The plate's flat sides as four trapezia, cut by hand.
            quad = [z + k, z + (k + 1) % 4, z + 4 + (k + 1) % 4, z + 4 + k]
            quad = quad if order == (0, 1) else quad[::-1]
            triangles += [[quad[0], quad[1], quad[2]], [quad[0], quad[2], quad[3]]]
    for face in faces[2:]:
        a, b, c, d = face.loop
        triangles += [[a, b, c], [a, c, d]]
    model = ObjectModel(np.concatenate(rings), edges_of_faces(faces), tuple(faces))
    return model, np.array(triangles)


def cases():
    rng = np.random.default_rng(1)
    solids = [stepped_block(0.06), roofed_block(0.06), random_polyhedron(rng, 12, 0.03)]
    yield ring()
    for solid in solids:
        yield model_of(solid), solid.triangles


def random_pose(rng, distance=0.3):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = [*rng.uniform(-0.02, 0.02, 2), distance]
    return pose


def reached(mesh, centre, points, slack):
    """Whether the first thing that rays from a centre meet is no nearer than the points."""
    hits, ray, _ = mesh.ray.intersects_location(
        np.tile(centre, (len(points), 1)), points - centre, multiple_hits=False
    )
    first = np.full(len(points), np.inf)
    first[ray] = np.linalg.norm(hits - centre, axis=1)
    return first > np.linalg.norm(points - centre, axis=1) - slack


def test_hidden_points_are_those_that_rays_do_not_reach():
    """Embree casts the rays."""
    trimesh = pytest.importorskip("trimesh")
    pytest.importorskip("embreex")
    rng, wrong, compared = np.random.default_rng(0), 0, 0
    for model, triangles in cases():
        mesh = trimesh.Trimesh(model.vertices, triangles, process=False)
        assert mesh.is_watertight
        wireframe = Wireframe.of(model)
        real = np.asarray(wireframe.sample_lengths) > 0.0
        points = np.concatenate([np.asarray(wireframe.samples)[real], model.vertices])
        for _ in range(8):
            pose = random_pose(rng)
            view = predicted(wireframe, CAMERA, pose)
            assert np.isfinite(np.asarray(view.vertices)).all()
            centre = -pose[:3, :3].T @ pose[:3, 3]
            vertices = np.asarray(view.vertex_visible)[: len(model.vertices)]
            shown = np.concatenate([np.asarray(view.sample_visible)[real], vertices])
            # What is just at the margin may go either way.
            slacks = [factor * float(wireframe.margin) for factor in (0.5, 1.0, 2.0)]
            answers = np.array([reached(mesh, centre, points, slack) for slack in slacks])
            clear = answers.all(axis=0) | ~answers.any(axis=0)
            wrong += (shown != answers[1])[clear].sum()
            compared += clear.sum()
            assert clear.mean() > 0.9
    assert compared > 2500
    assert wrong == 0


def stepped_poses():
    rng = np.random.default_rng(3)
    return [random_pose(rng, 0.2) for _ in PICTURES]


def render():
    """Write the pictures of a stepped block."""
    solid, calibration = stepped_block(0.06), sv.Calibration.eye_in_hand(BENT, *[np.eye(4)] * 2)
    for path, pose in zip(PICTURES, stepped_poses(), strict=True):
        scene = SolidScene((Surface.of_polyhedron(solid.moved(pose), matt(0.7)),))
        picture = render_solids(calibration, np.eye(4), scene, samples=16, noise=0.5)
        cv2.imwrite(str(path), picture)


def test_visible_vertices_are_where_the_rendered_corners_are():
    wireframe, gaps, hidden = Wireframe.of(model_of(stepped_block(0.06))), [], []
    for path, pose in zip(PICTURES, stepped_poses(), strict=True):
        corners = features.find(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), BENT)
        corners = corners.corners[corners.corner_segments[:, 1] >= 0]
        view = predicted(wireframe, BENT, pose)
        gap = np.linalg.norm(np.asarray(view.vertices)[:, None] - corners, axis=2).min(axis=1)
        visible = np.asarray(view.vertex_visible)
        gaps.append(gap[visible])
        hidden.append(gap[np.asarray(wireframe.vertex_mask) & ~visible])
    gaps, hidden = np.concatenate(gaps), np.concatenate(hidden)
    assert len(gaps) > 20
    assert len(hidden) > 5
    # Two faces of the same brightness have no edge between them, so not all are found.
    assert np.mean(gaps < 1.0) > 0.8
    assert np.median(gaps) < 0.3
    assert np.mean(hidden < 1.0) < 0.2


def test_an_edge_between_faces_that_look_away_is_hidden_without_anything_before_it():
    """Two walls of a box, seen from outside and from inside; without faces nothing is hidden."""
    whole = box()
    back = tuple(face for face in whole.faces if face.name in ("front", "right"))
    model = ObjectModel(whole.vertices, whole.edges, back)
    common = next(k for k, edge in enumerate(whole.edges.tolist()) if edge == [1, 5])
    # The camera on the outer side of both walls, and on their inner side, where no faces are left
    # that would hide anything.
    for azimuth, shown in ((-0.25, True), (0.75, False)):
        direction = np.array([np.cos(azimuth * np.pi), np.sin(azimuth * np.pi), 0.3])
        pose = host_matrices(look_at(whole.vertices[1], -direction, 0.3, 0.1))
        view = predicted(Wireframe.of(model), CAMERA, pose)
        assert (float(view.edge_px[common]) > 10.0) == shown
    bare = ObjectModel(whole.vertices, whole.edges)
    view = predicted(Wireframe.of(bare), CAMERA, pose)
    assert np.asarray(view.edge_px)[: len(bare.edges)].min() > 10.0


def test_what_is_behind_the_camera_or_outside_the_picture_is_not_visible():
    wireframe = Wireframe.of(box())
    behind, aside = np.eye(4), np.eye(4)
    behind[2, 3], aside[:3, 3] = -0.3, [0.3, 0.0, 0.3]
    for pose in (behind, aside):
        view = predicted(wireframe, CAMERA, pose)
        assert not np.asarray(view.vertex_visible).any()
        assert float(view.edge_px.sum()) == 0.0


def test_lengths_and_directions_are_those_of_the_projected_edges():
    model, rng = box(), np.random.default_rng(5)
    wireframe, pose = Wireframe.of(model), random_pose(rng)
    view = predicted(wireframe, CAMERA, pose)
    ends = np.asarray(view.vertices)[model.edges]
    spans = ends[:, 1] - ends[:, 0]
    lengths = np.linalg.norm(spans, axis=1)
    edge, real = np.asarray(wireframe.sample_edges), np.asarray(wireframe.sample_lengths) > 0.0
    total = np.bincount(edge[real], np.asarray(view.sample_px)[real])
    # Perspective makes the near half of an edge longer than the far one, their sum is the same.
    np.testing.assert_allclose(total, lengths, rtol=2e-3)
    along = (spans / lengths[:, None])[edge[real]]
    np.testing.assert_allclose(np.asarray(view.directions)[real], along, atol=1e-9)


def test_models_of_usual_size_share_one_program():
    rng = np.random.default_rng(2)
    solids = (stepped_block(), roofed_block(), random_polyhedron(rng, 14))
    shapes = {
        tuple(leaf.shape for leaf in jax.tree.leaves(Wireframe.of(model_of(solid))))
        for solid in solids
    }
    assert len(shapes) == 1


def test_poses_are_batched_and_differentiated():
    wireframe, rng = Wireframe.of(box()), np.random.default_rng(7)
    poses = np.stack([random_pose(rng) for _ in range(3)])

    def visible_length(tangent, pose):
        view = predict_view(wireframe, CAMERA, pose @ SE3.exp(tangent).as_matrix())
        return view.edge_px.sum(), view

    program = jax.jit(jax.vmap(jax.value_and_grad(visible_length, has_aux=True)))
    # By NumPy: JAX would compile two programs for each kind of array that is indexed.
    (_, batch), slopes = jax.tree.map(np.asarray, program(np.zeros((3, 6)), poses))
    step = 1e-6 * np.ones(6)
    for k, pose in enumerate(poses):
        alone = predicted(wireframe, CAMERA, pose)
        for one, many in zip(jax.tree.leaves(alone), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(many[k], np.asarray(one), atol=1e-9)
        after, before = (
            float(predicted(wireframe, CAMERA, pose @ host_exponentials(x)).edge_px.sum())
            for x in (step, -step)
        )
        assert 0.5 * (after - before) == pytest.approx(float(slopes[k] @ step), rel=1e-4)


def test_derivatives_by_the_pose_are_differences_of_pixels():
    pose, points = random_pose(np.random.default_rng(11)), np.asarray(box().vertices)
    program = compiled(pose_jacobians)
    pixels, derivatives = map(np.asarray, program(points, CAMERA, pose))
    # The camera has no distortion.
    seen = points @ pose[:3, :3].T + pose[:3, 3]
    drawn = seen[:, :2] / seen[:, 2:] * [600.0, 620.0] + [325.0, 236.0]
    np.testing.assert_allclose(pixels, drawn, rtol=1e-12)
    for k, step in enumerate(1e-6 * np.eye(6)):
        after, before = (
            np.asarray(program(points, CAMERA, pose @ host_exponentials(x))[0])
            for x in (step, -step)
        )
        differences = 0.5e6 * (after - before)
        np.testing.assert_allclose(derivatives[..., k], differences, rtol=1e-6, atol=1e-4)


@pytest.mark.parametrize(
    ("model", "samples", "said"),
    [
        (ObjectModel(np.zeros((0, 3)), name="air"), 128, "'air' has no edges"),
        (box(), 0, "samples: expected a positive number, found 0"),
        (ObjectModel(np.zeros((2, 3)), np.array([[0, 1]]), name="dot"), 128, "edge 0 of model"),
    ],
)
def test_models_that_cannot_be_looked_for_are_refused(model, samples, said):
    with pytest.raises(ValueError, match=said):
        Wireframe.of(model, samples)


if __name__ == "__main__":
    render()
