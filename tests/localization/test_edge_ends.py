"""How edges end that something hides, and at the corner of another solid."""

import numpy as np
import pytest
from drawn_edges import drawn, not_behind, seen_views, together
from solids import box

from smartview_jax.features import EdgePoints
from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Wireframe
from smartview_jax.localization.edge_ends import (
    Piece,
    edge_ends,
    edges_in_views,
    goes_on,
    is_crossed,
    log_likelihood_of_ends,
    pieces_of,
)
from smartview_jax.localization.edge_lookup import EdgeLookup
from smartview_jax.localization.refinement import measured_lines

MODEL, BAR = box(), box(0.012, 0.03, 0.08)
WIREFRAME = Wireframe.of(MODEL, 1024)
POSE = host_exponentials(np.array([0.01, 0.02, 0.03, 0.1, -0.1, 0.4]))
MIDDLE = POSE[:3, :3] @ MODEL.vertices.mean(axis=0) + POSE[:3, 3]
VIEWS = seen_views(MIDDLE)


def lines_in(pictures):
    lookup = EdgeLookup.of(pictures, VIEWS.camera.image_size)
    return measured_lines(WIREFRAME, VIEWS, lookup, POSE, 2.0)


def ends_in(pictures):
    return edge_ends(edges_in_views(lines_in(pictures), WIREFRAME), pictures)


def behind_a_bar():
    """The box, and a bar that stands before it in both views."""
    bar = host_exponentials(np.array([0.0, 0.0, 0.0, 1.3, 0.5, 0.3]))
    towards = VIEWS.centres.mean(axis=0) - MIDDLE
    bar[:3, 3] = MIDDLE + 0.15 * towards - bar[:3, :3] @ [0.006, 0.015, 0.04]
    box_behind = not_behind(drawn(MODEL, VIEWS, POSE, 0.05), VIEWS, BAR, bar)
    return together(box_behind, drawn(BAR, VIEWS, bar, 0.05))


def at_a_corner():
    """A smaller block that shares a corner with the box."""
    return drawn(box(0.045, 0.03, 0.03), VIEWS, POSE, 0.05)


def test_a_bar_cuts_edges_off_at_another_place_in_each_view():
    ends = ends_in(behind_a_bar())
    assert len(ends) >= 6
    assert np.mean([end.is_crossed for end in ends]) > 0.6
    assert not any(end.place == "same" for end in ends)


def test_edges_of_another_block_end_at_one_place():
    ends = ends_in(at_a_corner())
    assert len(ends) >= 4
    assert np.mean([end.is_crossed for end in ends]) < 0.3
    assert np.mean([end.place == "same" for end in ends]) > 0.5


def test_the_two_are_told_apart():
    hidden, wrong = (
        log_likelihood_of_ends(lines_in(pictures), WIREFRAME, pictures)
        for pictures in (behind_a_bar(), at_a_corner())
    )
    assert hidden > 3.0
    assert wrong < -3.0


def test_one_view_tells_of_the_outlines_alone():
    pictures = at_a_corner()
    lines = lines_in(pictures)
    first = type(lines)(*(part[:1] for part in lines))
    ends = edge_ends(edges_in_views(first, WIREFRAME), pictures[:1])
    assert ends
    assert {end.place for end in ends} == {"unknown"}


def test_what_is_too_short_is_no_piece():
    # Found, a dropout, found, missing, a chance point, missing, hidden by the object itself.
    kinds = np.repeat([1, 0, 1, 0, 1, 0, -1], [10, 1, 10, 10, 2, 10, 5])
    px = np.where(kinds < 0, 0.0, 2.0)
    assert pieces_of(kinds, px) == [
        Piece(1, 0, 21, 42.0),
        Piece(0, 21, 43, 44.0),
        Piece(-1, 43, 48, 0.0),
    ]


def along(start, direction, length):
    """Edge points of a straight edge, one a pixel."""
    direction = np.asarray(direction, dtype=float) / np.linalg.norm(direction)
    pixels = np.asarray(start) + np.arange(0.0, length)[:, None] * direction
    normals = np.tile([-direction[1], direction[0]], (len(pixels), 1))
    return EdgePoints(pixels, normals, np.ones(len(pixels)), np.round(pixels).astype(int))


def joined(*edges):
    return together(*([one] for one in edges))[0]


STEM = along([100.0, 200.0], [1.0, 0.0], 50.0)
END, OUT = np.array([149.0, 200.0]), np.array([1.0, 0.0])


@pytest.mark.parametrize(("angle", "crossed"), [(90.0, True), (50.0, True), (10.0, False)])
def test_an_outline_on_both_sides_crosses(angle, crossed):
    u = np.array([np.cos(np.deg2rad(angle)), np.sin(np.deg2rad(angle))])
    outline = along(END + 2.0 * OUT - 30.0 * u, u, 60.0)
    assert is_crossed(joined(STEM, outline), END, OUT) is crossed


def test_an_edge_that_begins_at_the_end_does_not_cross():
    corner = joined(STEM, along(END, [0.3, 1.0], 40.0), along(END, [0.5, -1.0], 40.0))
    assert not is_crossed(corner, END, OUT)
    one_side = joined(STEM, along(END, [0.0, 1.0], 40.0))
    assert not is_crossed(one_side, END, OUT)


def test_an_edge_that_goes_on_is_seen():
    assert not goes_on(STEM, END, OUT)
    assert goes_on(along([100.0, 200.0], [1.0, 0.0], 100.0), END, OUT)
    assert not goes_on(joined(STEM, along(END, [1.0, 0.4], 40.0)), END, OUT)
