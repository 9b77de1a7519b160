"""How deep solids at given poses overlap, by shapes whose overlap is known."""

import dataclasses

import numpy as np
import pytest
from solids import box, prism

from smartview_jax.localization.solid_overlap import (
    convex_parts,
    in_one_place,
    overlap_deeper,
    thickness,
)
from smartview_jax.modeling import Face, ObjectModel, edges_of_faces

HERE = np.eye(4)


def at(x=0.0, y=0.0, z=0.0):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def is_as_deep(depth, model, pose, other, other_pose):
    shallower, deeper = (
        overlap_deeper(model, pose, other, other_pose, k * depth) for k in (0.999, 1.001)
    )
    return shallower and not deeper


def channel(width=0.03, height=0.02, wall=0.003, length=0.06):
    """A U along z, open towards y."""
    w, h, t = width, height, wall
    profile = [(0, 0), (w, 0), (w, h), (w - t, h), (w - t, t), (t, t), (t, h), (0, h)]
    vertices = np.array([[x, y, z] for z in (0.0, length) for x, y in profile])
    sides = [(k, (k + 1) % 8, 8 + (k + 1) % 8, 8 + k) for k in range(8)]
    loops = [tuple(range(8))[::-1], tuple(range(8, 16)), *sides]
    faces = tuple(Face(loop) for loop in loops)
    return ObjectModel(vertices, edges_of_faces(faces), faces)


BAR, CHANNEL = box(0.15, 0.01, 0.014), channel()


def test_bars_overlap_by_what_they_share():
    assert not overlap_deeper(BAR, HERE, BAR, at(y=0.025), 0.0)
    assert is_as_deep(0.003, BAR, HERE, BAR, at(y=0.007))
    # Pushed along: half of the bar is common, as thick as the bar.
    assert is_as_deep(0.01, BAR, HERE, BAR, at(x=0.075))


def test_an_upright_edge_in_a_face_leaves_room_for_a_ball_in_its_wedge():
    """A ball that touches the face and both sides of a right angle, 10 mm deep."""
    cube, half = box(0.1, 0.1, 0.1), np.sqrt(0.5)
    turned = at(0.09 + 0.1 * half, 0.05 - 0.1 * half)
    turned[:2, :2] = [[half, -half], [half, half]]
    assert is_as_deep(0.02 / (1.0 + np.sqrt(2.0)), cube, HERE, cube, turned)


def test_a_bar_in_a_channel_does_not_overlap_with_it():
    assert thickness(CHANNEL) == pytest.approx(0.003)
    assert len(convex_parts(CHANNEL)) == 3
    within = box(0.01, 0.01, 0.04)
    assert not overlap_deeper(CHANNEL, HERE, within, at(0.01, 0.004, 0.01), 0.0)
    assert is_as_deep(0.001, CHANNEL, HERE, within, at(0.01, 0.002, 0.01))
    assert not in_one_place(CHANNEL, HERE, within, at(0.01, 0.004, 0.01))
    assert in_one_place(CHANNEL, HERE, within, at(0.01, 0.0, 0.01))


def test_a_frame_with_a_hole_is_cut_about_the_hole():
    outer, inner = (np.array([[-a, -a], [a, -a], [a, a], [-a, a]]) for a in (0.03, 0.02))
    vertices = np.array([[*p, z] for z in (0.0, 0.01) for p in (*outer, *inner)])
    top, bottom = Face((8, 9, 10, 11), ((12, 15, 14, 13),)), Face((3, 2, 1, 0), ((4, 5, 6, 7),))
    outside = [Face((k, (k + 1) % 4, 8 + (k + 1) % 4, 8 + k)) for k in range(4)]
    inside = [Face((4 + (k + 1) % 4, 4 + k, 12 + k, 12 + (k + 1) % 4)) for k in range(4)]
    faces = (top, bottom, *outside, *inside)
    frame = ObjectModel(vertices, edges_of_faces(faces), faces)
    volumes = sum(8.0 * part.radius**3 for part in convex_parts(frame))
    assert volumes > 0.0
    peg = box(0.03, 0.03, 0.01)
    assert not overlap_deeper(frame, HERE, peg, at(-0.015, -0.015), 0.0)
    assert is_as_deep(0.005, frame, HERE, peg, at(-0.005, -0.015))


def test_a_measured_solid_has_the_parts_of_the_exact_one():
    rng = np.random.default_rng(0)
    for model, count in ((box(), 1), (CHANNEL, 3)):
        noise = 5e-5 * rng.standard_normal(model.vertices.shape)
        measured = dataclasses.replace(
            model,
            vertices=model.vertices + noise,
            covariance=np.tile(5e-5**2 * np.eye(3), (len(noise), 1, 1)),
        )
        assert len(convex_parts(measured)) == count
        assert thickness(measured) == pytest.approx(thickness(model), abs=3e-4)


def test_errors_of_the_poses_are_tolerated_but_two_equal_poses_never():
    touching = at(y=0.0095)
    assert in_one_place(BAR, HERE, BAR, touching, tolerance=0.0) is False
    nearer = at(y=0.008)
    assert in_one_place(BAR, HERE, BAR, nearer)
    assert not in_one_place(BAR, HERE, BAR, nearer, tolerance=0.002)
    assert in_one_place(BAR, HERE, BAR, HERE, tolerance=1.0)


def test_a_model_without_volume_is_in_one_place_with_what_is_near():
    flat = ObjectModel(box().vertices[:4] * 1.0, np.array([[0, 1], [1, 3], [3, 2], [2, 0]]))
    assert thickness(flat) == 0.0
    assert in_one_place(flat, HERE, flat, at(x=0.02))
    assert not in_one_place(flat, HERE, flat, at(x=0.05))


def test_a_convex_model_is_one_part():
    for model in (box(), prism(12)):
        (part,) = convex_parts(model)
        assert (model.vertices @ part.normals.T <= part.offsets + 1e-9).all()
    # Without faces the hull stands for the solid.
    bare = dataclasses.replace(CHANNEL, faces=())
    assert len(convex_parts(bare)) == 1
