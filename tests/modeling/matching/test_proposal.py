"""Proposals from the package's object sample, whose truth is known, and from real pictures."""

import numpy as np
import pytest

from smartview_jax import features
from smartview_jax.geometry import host_matrices
from smartview_jax.io import load_object_views, object_sample_folder
from smartview_jax.modeling import Region, propose_model
from smartview_jax.simulation import example_solid, paper_calibration

CALIBRATION = paper_calibration()
DEPTHS = (0.1, 0.3)


@pytest.fixture(scope="module")
def views():
    return load_object_views(object_sample_folder() / "object")


@pytest.fixture(scope="module")
def found(views):
    return [features.find(picture, CALIBRATION.camera) for picture in views.pictures]


@pytest.fixture(scope="module")
def proposal(views, found):
    poses = host_matrices(views.base_from_tool)
    return propose_model(CALIBRATION, poses, views.pictures, DEPTHS, features=found)


def test_most_vertices_of_the_object_are_proposed(proposal):
    """Ten of the twelve are seen from the five viewpoints; the robot errs by 0.03 mm and 0.3 px."""
    vertices = example_solid().vertices
    gap = np.linalg.norm(proposal.points[None] - vertices[:, None], axis=2).min(axis=1)
    assert (gap < 5e-4).sum() >= 9


def test_points_that_all_views_agree_on_are_on_the_surfaces(proposal):
    """The table, the faces of the solid and of the boxes, or a shadow's border on one of them."""
    everywhere = proposal.points[(proposal.corners >= 0).sum(axis=0) == 5]
    assert len(everywhere) > 50
    solid = example_solid()
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    assert ((everywhere[:, 2] > -1e-3) & (everywhere[:, 2] < high[2] + 1e-3)).all()
    outside = np.maximum(low - everywhere, everywhere - high)[:, :2]
    elsewhere = outside.max(axis=1) > 1e-3
    # Next to the solid are the table and two boxes of 5 and 6 mm.
    assert everywhere[elsewhere, 2].max() < 7e-3
    assert np.median(np.abs(everywhere[elsewhere, 2])) < 3e-4


def distance_to_segment(points, a, b):
    along = np.clip((points - a) @ (b - a) / ((b - a) @ (b - a)), 0.0, 1.0)
    return np.linalg.norm(points - a - along[:, None] * (b - a), axis=1)


def test_edges_of_the_object_are_covered_by_edges(proposal):
    """Labels that cross an edge of the object divide it, so lengths are added up."""
    solid = example_solid()
    ends = proposal.points[proposal.edges]
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    covered = []
    for a, b in solid.vertices[solid.edges]:
        on_edge = [distance_to_segment(ends[:, k], a, b) < 5e-4 for k in (0, 1)]
        covered.append(lengths[on_edge[0] & on_edge[1]].sum() / np.linalg.norm(b - a))
    # Of the eighteen, four are below or behind, and some have the same brightness on either side.
    assert (np.array(covered) > 0.8).sum() >= 7
    assert max(covered) < 1.1
    assert ((proposal.edge_segments >= 0).sum(axis=0) >= 2).all()


def test_evidence_belongs_to_the_points(proposal, views):
    assert ((proposal.corners >= 0).sum(axis=0) >= 3).all()
    assert (proposal.rms < 1.0).all()
    poses = host_matrices(views.base_from_tool)
    predicted = np.asarray(CALIBRATION.project(poses, proposal.points)[0])
    squared = ((predicted - proposal.pixels) ** 2).sum(axis=-1)
    np.testing.assert_allclose(np.sqrt(np.nanmean(squared, axis=0)), proposal.rms, atol=1e-6)
    for k, (corners, pixels) in enumerate(zip(proposal.corners, proposal.pixels, strict=True)):
        own = corners >= 0
        np.testing.assert_array_equal(proposal.features[k].corners[corners[own]], pixels[own])
        assert len(np.unique(corners[own])) == own.sum()
        segments = proposal.edge_segments[k]
        assert segments.max() < len(proposal.features[k].segments)
    assert (np.linalg.eigvalsh(proposal.covariances) > 0.0).all()


def test_two_views_are_enough_if_asked_for(views):
    """Also their features are found where none are given."""
    poses = host_matrices(views.base_from_tool)[:2]
    pair = propose_model(CALIBRATION, poses, views.pictures[:2], DEPTHS)
    assert ((pair.corners >= 0).sum(axis=0) == 2).all()
    vertices = example_solid().vertices
    gap = np.linalg.norm(pair.points[None] - vertices[:, None], axis=2).min(axis=1)
    assert (gap < 1e-3).sum() >= 6


def test_pictures_of_different_things_agree_on_nothing(views, found):
    poses = host_matrices(views.base_from_tool)[:3]
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, views.pictures[0].shape, np.uint8) for _ in range(3)]
    size = np.array(noise[0].shape[::-1])
    anywhere = [track._replace(corners=rng.uniform(5.0, size - 6.0, track.corners.shape))
                for track in found[:3]]  # fmt: skip
    proposal = propose_model(CALIBRATION, poses, noise, DEPTHS, features=anywhere)
    assert len(proposal.points) <= 3


def test_a_view_in_which_nothing_is_seen_takes_nothing_from_the_others(views, found):
    """Such as one with a hand before the camera."""
    nothing = features.Features(
        *(part[:0] if isinstance(part, np.ndarray) else part for part in found[2])
    )
    assert len(nothing.corners) == 0
    poses, others = host_matrices(views.base_from_tool), [0, 1, 3, 4]
    given = [*found[:2], nothing, *found[3:]]
    with_it = propose_model(CALIBRATION, poses, views.pictures, DEPTHS, features=given)
    without = propose_model(
        CALIBRATION,
        poses[others],
        [views.pictures[k] for k in others],
        DEPTHS,
        features=[found[k] for k in others],
    )
    assert len(without.points) > 50
    assert (with_it.corners[2] == -1).all()
    # Patches are turned by the mean of all cameras, so that a few that are just alike differ.
    gap = np.linalg.norm(with_it.points[None] - without.points[:, None], axis=2).min(axis=1)
    assert np.mean(gap < 1e-6) > 0.9
    assert abs(len(with_it.edges) - len(without.edges)) < 0.1 * len(without.edges)
    blind = propose_model(CALIBRATION, poses, views.pictures, DEPTHS, features=[nothing] * 5)
    assert len(blind.points) == len(blind.edges) == 0


@pytest.mark.parametrize("wrong", ["picture", "features"])
def test_a_view_of_another_size_is_named(views, found, wrong):
    poses, pictures, given = host_matrices(views.base_from_tool), list(views.pictures), list(found)
    if wrong == "picture":
        pictures[2] = np.ascontiguousarray(pictures[2][:240, :320])
        said = "view 2: picture: expected 640 x 480 px, the camera's size, found 320 x 240 px"
    else:
        given[1] = given[1]._replace(image_size=(320, 240))
        said = "view 1: features of a picture of 320 x 240 px; the camera's have 640 x 480 px"
    with pytest.raises(ValueError, match=said):
        propose_model(CALIBRATION, poses, pictures, DEPTHS, features=given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"poses": slice(1)}, "expected at least two views, found 1"),
        ({"pictures": slice(3)}, "pictures: expected one for each of 5 poses, found 3"),
        ({"features": slice(4)}, "features: expected one for each of 5 views, found 4"),
        ({"depths": (0.3, 0.1)}, "depths: expected 0 <= near < far, found 0.3 and 0.1"),
        ({"min_views": 6}, "min_views: expected 2 to 5, found 6"),
    ],
)
def test_wrong_arguments_are_named(views, found, change, message):
    poses = host_matrices(views.base_from_tool)[change.get("poses", slice(None))]
    with pytest.raises(ValueError, match=message):
        propose_model(
            CALIBRATION,
            poses,
            views.pictures[change.get("pictures", slice(None))],
            change.get("depths", DEPTHS),
            features=found[change.get("features", slice(None))],
            min_views=change.get("min_views"),
        )


def test_the_view_of_a_bad_picture_is_named(views):
    pictures = list(views.pictures)
    pictures[0] = np.full_like(pictures[0], 100)
    poses = host_matrices(views.base_from_tool)
    with pytest.raises(ValueError, match="view 0: picture: blank"):
        propose_model(CALIBRATION, poses, pictures, DEPTHS)


def around(pixels, margin=12.0):
    return [*(pixels.min(axis=0) - margin), *(pixels.max(axis=0) + margin)]


def pixels_of(views, points):
    """Pixels of points in all views."""
    return np.asarray(CALIBRATION.project(host_matrices(views.base_from_tool), points)[0])


@pytest.fixture(scope="module")
def projected(views):
    """Pixels of the solid's vertices in all views."""
    return pixels_of(views, example_solid().vertices)


def test_a_box_leaves_out_what_is_outside_and_keeps_what_is_inside(views, found, proposal):
    vertices = example_solid().vertices
    box = np.array([vertices.min(axis=0) - 2e-3, vertices.max(axis=0) + 2e-3])
    # The table under the solid is within its box in z, so only above it.
    box[0, 2] = 1e-3
    poses = host_matrices(views.base_from_tool)
    within = propose_model(
        CALIBRATION, poses, views.pictures, DEPTHS, features=found, region=Region(box)
    )
    assert ((within.points >= box[0]) & (within.points <= box[1])).all()
    everywhere = ((proposal.points >= box[0]) & (proposal.points <= box[1])).all(axis=1)
    assert len(within.points) >= everywhere.sum()
    assert len(within.points) < 0.9 * len(proposal.points)
    # Edges number the points that are left.
    ends = within.points[within.edges]
    lengths = np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1)
    assert len(lengths) > 5
    assert lengths.max() < np.linalg.norm(box[1] - box[0])
    assert within.edge_segments.shape == (5, len(within.edges))
    top = vertices[:, 2] > 2e-3
    gap = np.linalg.norm(within.points[None] - vertices[:, None], axis=2).min(axis=1)
    assert (gap[top] < 5e-4).sum() >= 5


def test_one_rectangle_leaves_out_what_is_next_to_the_object_in_all_views(
    views, found, projected, proposal
):
    rectangle = around(projected[1])
    region = Region(rectangles={1: rectangle})
    poses = host_matrices(views.base_from_tool)
    within = propose_model(
        CALIBRATION, poses, views.pictures, DEPTHS, features=found, region=region
    )
    assert 20 < len(within.points) < 0.8 * len(proposal.points)
    (low, high) = np.reshape(rectangle, (2, 2))
    seen = within.pixels[1]
    # A corner is up to 2 px from where its point is seen.
    with np.errstate(invalid="ignore"):
        assert not ((seen < low - 2.0) | (seen > high + 2.0)).any()
    # Points that this view does not see are within the rectangle, too.
    pixels = pixels_of(views, within.points)
    assert ((pixels[1] >= low) & (pixels[1] <= high)).all()
    vertices = example_solid().vertices
    gap = np.linalg.norm(within.points[None] - vertices[:, None], axis=2).min(axis=1)
    assert (gap < 5e-4).sum() >= 9


@pytest.mark.parametrize(
    ("region", "said"),
    [
        (Region([[0, 0, 1], [1, 1, 0]]), r"smallest x, y and z \(m\) below .* found \[\[0.0, 0.0"),
        (Region([[0, 0, np.nan], [1, 1, 1]]), "a box has"),
        (Region(rectangles={7: (0, 0, 9, 9)}), "no view number 7, only 0 to 4"),
        (Region(rectangles={-1: (0, 0, 9, 9)}), "no view number -1"),
        (Region(rectangles={2: (9, 0, 9, 9)}), "view 2: expected u 9 below 9"),
        (Region(rectangles={2: (0, 0, 9)}), "view 2: a rectangle is four numbers"),
        (Region(rectangles={2: (9000, 0, 9001, 9)}), "view 2: .* outside of the picture of"),
    ],
)
def test_a_region_with_nothing_inside_is_refused(views, found, region, said):
    poses = host_matrices(views.base_from_tool)
    with pytest.raises(ValueError, match=said):
        propose_model(CALIBRATION, poses, views.pictures, DEPTHS, features=found, region=region)
