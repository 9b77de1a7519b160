"""Which views are taken of a region, when it is enough, and what a bad picture costs."""

import numpy as np
import pytest
from fake_cell import BLANK, CALIBRATION, REGION, STRIPED, FakeCell, localizations, seen, view_of
from solids import box

from smartview_jax.engine import Noise
from smartview_jax.geometry import host_matrices, viewing_direction
from smartview_jax.grasping import GraspScene, Obstacle
from smartview_jax.joint import RigEstimate, SavedEstimate
from smartview_jax.picking import BadPictureError, FirstViews, LookOptions, Region, look_for
from smartview_jax.simulation import CellError

MODEL = box(name="box")
ACCEPTED, OPEN = seen(MODEL), seen(MODEL, "open", "ambiguous")


@pytest.fixture
def look(monkeypatch):
    """Look by a cell whose pictures show, one call after the other, what is given."""

    def run(cell, *found, estimate=None, noise=None, **options):
        answers = list(found)
        run.looked_at, run.noises, run.searches = [], [], []

        def localize(evidence, command, *, previous=None, **given):
            run.searches.append(given)
            assert len(evidence) == (1 if previous else 2)
            return localizations(*answers.pop(0))

        def next_view(objects, *_, noise=None, **__):
            run.looked_at.append([obj.verdict.decision for obj in objects])
            run.noises.append(noise)
            return view_of()

        monkeypatch.setattr("smartview_jax.picking.looking.localize", localize)
        monkeypatch.setattr("smartview_jax.picking.looking.next_view", next_view)
        scene = GraspScene(CALIBRATION, (Obstacle.table(),), estimate=estimate)
        given = LookOptions(**options)
        return look_for(cell, scene, [MODEL], REGION, options=given, noise=noise)

    return run


def test_the_corners_of_a_region_are_a_boxs_on_its_floor():
    corners = Region(np.array([0.1, -0.1, 0.0]), (0.24, 0.18, 0.08)).corners
    assert np.allclose(corners.min(axis=0), [-0.02, -0.19, 0.0])
    assert np.allclose(corners.max(axis=0), [0.22, -0.01, 0.08])


@pytest.mark.parametrize(
    ("bad", "why"), [(BLANK, "picture: blank"), (CellError("no light"), "no light")]
)
def test_a_bad_later_picture_leaves_what_two_views_found(look, bad, why):
    cell = FakeCell(STRIPED, STRIPED, bad)
    result = look(cell, [ACCEPTED])
    assert result.found.accepted
    assert len(result.pictures) == len(host_matrices(result.commands.base_from_tool)) == 2
    assert result.verification is None
    (note,) = result.notes
    assert note.startswith(f"no further view: view 3: {why}")


def test_a_bad_first_picture_is_an_error_that_names_the_view(look):
    with pytest.raises(BadPictureError, match="view 2: picture: blank"):
        look(FakeCell(STRIPED, BLANK))
    with pytest.raises(BadPictureError, match="view 1: no light"):
        look(FakeCell(CellError("no light")))


def test_two_views_are_enough_where_nothing_is_verified(look):
    result = look(FakeCell(), [ACCEPTED], verify=False)
    assert len(result.pictures) == 2
    assert result.verification is None
    assert result.notes == ()


def test_what_is_accepted_is_verified_from_one_view(look):
    cell = FakeCell()
    result = look(cell, [ACCEPTED, ACCEPTED], [ACCEPTED, ACCEPTED])
    assert look.looked_at == [["accepted"]]
    assert len(result.pictures) == len(cell.moves) == 3
    assert result.verification is not None
    assert result.notes == ("view 3: it separates the object from 1 remaining rival",)


def test_a_view_that_brings_less_than_it_costs_is_not_taken(look):
    """The view of `look` gains one nat."""
    cell = FakeCell()
    for localization in (ACCEPTED, OPEN):
        result = look(cell, [localization], view_cost=1.5)
        assert len(result.pictures) == 2
        assert result.verification is None
        assert result.notes[0].startswith(
            "no further view: view 3 would gain 1 nats and costs 1.5: it separates"
        )


def test_what_is_open_is_looked_at_after_what_is_accepted(look):
    result = look(FakeCell(), [ACCEPTED, OPEN], [ACCEPTED, OPEN], [ACCEPTED, ACCEPTED])
    assert look.looked_at == [["accepted"], ["open"]]
    assert len(result.found.accepted) == 2


def test_what_stays_open_is_looked_at_until_no_view_is_left(look):
    result = look(FakeCell(), *[[OPEN, ACCEPTED]] * 4, max_views=5, verify=False)
    assert look.looked_at == [["open"]] * 3
    assert len(result.pictures) == 5


def test_the_view_that_decided_has_verified(look):
    look(FakeCell(), [OPEN], [ACCEPTED])
    assert look.looked_at == [["open"]]


def test_nothing_found_needs_no_further_view(look):
    result = look(FakeCell(), [seen(MODEL, "rejected", "too few edges")])
    assert look.looked_at == []
    assert result.found.messages == ("box: not found: too few edges",)


def test_the_noise_is_given_or_that_of_the_estimate(look):
    own, given = Noise(0.1, 1e-3, 1e-3), Noise(0.1, 2e-3, 1e-3)
    estimate = SavedEstimate(CALIBRATION, np.eye(2), ("a", "b"), own, 0.1, None)
    for noise in (None, given):
        look(FakeCell(), [ACCEPTED], [ACCEPTED], estimate=estimate, noise=noise)
        assert look.noises == [noise or own]
    look(FakeCell(), [ACCEPTED], [ACCEPTED])
    assert look.noises == [None]


def test_every_search_knows_the_scene(look):
    estimate = SavedEstimate(CALIBRATION, np.eye(2), ("a", "b"), None, 0.1, None)
    look(FakeCell(), [ACCEPTED], [ACCEPTED], estimate=estimate)
    assert len(look.searches) == 2
    for search in look.searches:
        assert search["calibration"] is CALIBRATION
        assert search["covariance"] is estimate
        assert search["occluders"].shape == (12, 3, 3)
        assert np.array_equal(search["workspace"], REGION.corners[[0, -1]])


def directions(moves):
    """Viewing directions of the commands that were reached; base and world are one frame."""
    poses = [host_matrices(move.base_from_tool) for move in moves if move is not None]
    return np.stack([pose[:3, 2] for pose in poses])


def test_another_azimuth_is_tried_where_one_is_not_reached(look):
    cell, first = FakeCell(), FirstViews(0.3, 0.2, (0.0, 1.0, 2.0))
    cell.unreachable = (1,)
    result = look(cell, [ACCEPTED], first=first, verify=False)
    expected = viewing_direction(0.2, np.array([0.0, 2.0]))
    np.testing.assert_allclose(directions(cell.moves), expected, atol=1e-6)
    assert len(result.pictures) == 2
    # Aimed a quarter of the region's height above its floor.
    at = host_matrices(cell.moves[0].base_from_tool)[:3, 3] + 0.3 * directions(cell.moves)[0]
    np.testing.assert_allclose(at, REGION.centre + np.array([0.0, 0.0, 0.02]), atol=1e-6)


def test_too_few_reached_views_say_why(look):
    cell = FakeCell()
    cell.unreachable = (0, 2, 3)
    with pytest.raises(CellError, match=r"1 of 4 views are reached; expected 2: azimuth 0.6 rad: "):
        look(cell)
    assert len(cell.moves) == 4


def test_the_estimate_is_of_the_camera_that_takes_the_pictures(look):
    rig = RigEstimate({"left": CALIBRATION}, np.zeros((0, 0)), (), {}, Noise(0.1, 1e-4, 1e-4))
    with pytest.raises(TypeError, match=r"rig_fit.estimate\('left'\), found RigEstimate"):
        look(FakeCell(STRIPED, STRIPED), estimate=rig)
