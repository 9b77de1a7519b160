"""Which face of a model the pictures do not confirm, on drawn edges of other solids."""

import dataclasses

import numpy as np
import pytest
from drawn_edges import drawn
from placed_box import MODEL, POSE
from solids import box

from smartview_jax.localization import EdgeLookup, Wireframe
from smartview_jax.localization.confirmed_faces import (
    CONFIRMED_SHARE,
    largest_unconfirmed_face,
)
from smartview_jax.localization.edge_lines import EXPLAINED_DISTANCE
from smartview_jax.localization.refinement import measured_lines

SIDES = np.ptp(MODEL.vertices, axis=0)


def asked(views, seen, model=MODEL, **more):
    """The answer at the true pose of a model whose place a seen solid takes, and the lines."""
    wireframe = Wireframe.of(model, 512)
    lookup = EdgeLookup.of(drawn(seen, views, POSE, 0.05, **more), views.camera.image_size)
    lines = measured_lines(wireframe, views, lookup, POSE, EXPLAINED_DISTANCE)
    return largest_unconfirmed_face(lines, wireframe), lines


def test_of_the_object_itself_every_face_is_confirmed(views):
    assert asked(views, MODEL)[0] == 0.0


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("stretch", [0.7, 1.4])
def test_a_block_of_another_length_lacks_one_face(views, axis, stretch):
    """Its far face is elsewhere: the size is that of the face's edges in both pictures."""
    size, lines = asked(views, box(*(SIDES * np.where(np.arange(3) == axis, stretch, 1.0))))
    on_face = (MODEL.vertices[MODEL.edges][:, :, axis] == SIDES[axis]).all(axis=1)
    visible = lines.visible_px[:, : len(on_face)]
    assert size == pytest.approx(visible[:, on_face].sum() / visible.sum())
    assert size > 0.1


def test_one_short_edge_that_is_there_by_chance_confirms_no_face(views):
    """Of the far face the shortest edge is left, as if it were that of something else."""
    far = [k for k, edge in enumerate(MODEL.edges) if (MODEL.vertices[edge, 0] == SIDES[0]).all()]
    lengths = np.linalg.norm(np.diff(MODEL.vertices[MODEL.edges[far]], axis=1)[:, 0], axis=1)
    _, lines = asked(views, MODEL)
    seen = [k for k in far if lines.visible_px[:, k].sum() > 0.0]
    shortest = seen[int(np.argmin([lines.visible_px[:, k].sum() for k in seen]))]
    share = lines.visible_px[:, shortest].sum() / lines.visible_px[:, far].sum()
    assert len(lengths) == 4
    size, _ = asked(views, MODEL, hidden=[k for k in far if k != shortest])
    assert (size > 0.1) == (share < CONFIRMED_SHARE)
    assert asked(views, MODEL, hidden=far)[0] > 0.1
    assert asked(views, MODEL, hidden=far[:1])[0] == 0.0


def test_edges_that_are_off_confirm_nothing(views):
    """A block 1 % larger has edges a pixel or so beside those of the model."""
    rng = np.random.default_rng(0)
    assert asked(views, MODEL, shift=1.2, rng=rng)[0] > 0.0


def test_a_model_without_faces_cannot_be_confirmed(views):
    assert np.isnan(asked(views, MODEL, dataclasses.replace(MODEL, faces=()))[0])
