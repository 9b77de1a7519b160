"""From hypotheses to verdicts, and the next view, on drawn edges with known truth."""

import copy
import dataclasses
import inspect
import pickle
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from drawn_edges import (
    IMAGE_SIZE,
    TWO_DIRECTIONS,
    calibration,
    drawn,
    evidence,
    poses_towards,
    seen_views,
    together,
)
from placed_box import projected
from solids import box, prism

import smartview_jax as sv
from smartview_jax.engine import Noise
from smartview_jax.features import EdgePoints
from smartview_jax.geometry import host_exponentials, host_logarithms, host_transforms
from smartview_jax.localization import (
    Hypothesis,
    Reachable,
    SearchOptions,
    VerdictOptions,
    localize,
    next_view,
    search_rounds,
)
from smartview_jax.localization.refining.pose_convergence import lengths_of_poses
from smartview_jax.modeling import ObjectModel, find_symmetry
from smartview_jax.robots import Command

PLAIN = box()
MODEL = dataclasses.replace(PLAIN, name="box", symmetry=find_symmetry(PLAIN))
POSE = host_exponentials(np.array([0.01, 0.02, 0.03, 0.1, -0.1, 0.4]))
MIDDLE = POSE[:3, :3] @ MODEL.vertices.mean(axis=0) + POSE[:3, 3]
POSES = poses_towards(MIDDLE, TWO_DIRECTIONS)
CALIBRATION = calibration()
BACK = [face.name for face in MODEL.faces].index("back")


def poses_of_both(between):
    """Two views in which two boxes are, with something between them, m from the first one."""
    return poses_towards(MIDDLE + 0.5 * POSE[:3, :3] @ between, TWO_DIRECTIONS, 0.6)


def clutter(rng, count=10):
    """Straight edges of other things anywhere in the pictures."""
    pictures = []
    for _ in range(2):
        starts, angles = (
            rng.uniform([50, 50], [575, 425], (count, 2)),
            rng.uniform(0, 6.3, count),
        )
        lengths = rng.uniform(40.0, 250.0, count)
        t = [np.arange(0.0, length) for length in lengths]
        d = np.column_stack([np.cos(angles), np.sin(angles)])
        pixels = np.concatenate([s + x[:, None] * v for s, x, v in zip(starts, t, d, strict=True)])
        normals = np.concatenate(
            [np.tile([-v[1], v[0]], (len(x), 1)) for x, v in zip(t, d, strict=True)]
        )
        pixels = pixels + 0.1 * rng.standard_normal((len(pixels), 1)) * normals
        cells = np.round(pixels).astype(int)
        inside = ((cells >= 0) & (cells < IMAGE_SIZE)).all(axis=1)
        strengths = np.full(int(inside.sum()), 20.0)
        pictures.append(EdgePoints(pixels[inside], normals[inside], strengths, cells[inside]))
    return pictures


def views():
    return seen_views(MIDDLE)


def starts(pose=POSE, count=3, model=0, seed=0):
    rng = np.random.default_rng(seed)
    tangents = np.concatenate(
        [1e-3 * rng.standard_normal((count, 3)), 0.01 * rng.standard_normal((count, 3))], axis=1
    )
    return [Hypothesis(model, pose @ host_exponentials(t), 0.0, 0.0) for t in tangents]


def find(pictures, models=MODEL, hypotheses=None, poses=POSES, **more):
    given = starts() if hypotheses is None else hypotheses
    return localize(evidence(pictures), poses, CALIBRATION, models, hypotheses=given, **more)


@pytest.fixture(scope="module")
def pictures():
    return together(drawn(MODEL, views(), POSE, 0.1), clutter(np.random.default_rng(1)))


@pytest.fixture(scope="module")
def found(pictures):
    return find(pictures)


def test_an_object_is_found_with_its_covariance(found):
    (localization,) = found
    assert localization.verdict.decision == "accepted"
    assert found.accepted == (localization,)
    assert found.messages == ()
    errors = [host_logarithms(np.linalg.inv(POSE) @ pose) for pose in localization.equivalent_poses]
    error = min(errors, key=np.linalg.norm)
    assert np.linalg.norm(error[:3]) < 1e-4
    assert error @ np.linalg.solve(localization.covariance, error) < 25.0
    assert len(localization.equivalent_poses) == 4
    assert localization.verdict.evidence.explained > 0.9
    assert all(match.found_px <= match.visible_px + 1e-9 for match in localization.matches)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_what_was_found_is_copied_whole(found, copied):
    other = copied(found)
    assert [localization.message for localization in other] == [
        localization.message for localization in found
    ]
    assert other.messages == found.messages
    assert other.accepted[0].verdict == found.accepted[0].verdict
    np.testing.assert_array_equal(other[0].covariance, found[0].covariance)
    np.testing.assert_array_equal(
        other.pictures[1].edge_points.pixels, found.pictures[1].edge_points.pixels
    )
    given, own = (results.command.base_from_tool.as_matrix() for results in (found, other))
    np.testing.assert_array_equal(own, given)


def test_a_symmetry_that_is_not_known_is_ambiguous(pictures):
    turned = POSE @ MODEL.symmetry.object_from_object[1]
    localizations = find(pictures, PLAIN, starts() + starts(turned))
    assert [localization.verdict.decision for localization in localizations] == ["open"]
    assert "ambiguous" in localizations.messages[0]
    assert localizations[0].rivals


def test_a_pose_that_is_drawn_to_the_found_one_is_no_rival(pictures, monkeypatch):
    """The search may leave two poses apart that the fit brings together, and others it does not."""

    def left_as_they_are(wireframe, views, lookup, poses):
        return poses, lengths_of_poses(wireframe, views, lookup, poses)

    monkeypatch.setattr(
        "smartview_jax.localization.judging.candidates.poses_on_edges", left_as_they_are
    )
    # All rivals decide, and 1 mm is another pose: what differs is 4 px.
    lenient = VerdictOptions(min_margin=1e3)
    monkeypatch.setattr("smartview_jax.localization.judging.candidates.SAME_POSE", 0.01)
    near = POSE @ host_exponentials(np.array([1e-3, 0.0, 0.0, 0.0, 0.0, 0.0]))
    turned = POSE @ MODEL.symmetry.object_from_object[1]
    given = [Hypothesis(0, p, 0.0, 0.0) for p in (POSE, near, turned)]
    localizations = find(pictures, PLAIN, given, options=lenient)
    (rival,) = localizations[0].rivals
    # Either may be the likelier by a hair.
    both = np.stack([localizations[0].world_from_object, rival.world_from_object])
    expected = np.stack([POSE, turned])[:: 1 if both[0, 0, 0] * POSE[0, 0] > 0.0 else -1]
    np.testing.assert_allclose(both, expected, atol=1e-3)


def test_another_object_is_not_accepted(pictures):
    other = dataclasses.replace(prism(6), name="prism")
    hypotheses = [
        Hypothesis(0, POSE @ host_exponentials(t), 0.0, 0.0)
        for t in 0.02 * np.random.default_rng(2).standard_normal((8, 6)) * [1, 1, 1, 40, 40, 40]
    ]
    localizations = find(pictures, other, hypotheses)
    assert not localizations.accepted
    assert "prism: not found" in localizations.messages[0]


def test_a_box_of_another_height_is_not_accepted(pictures):
    """Its top fits exactly, and the top is most of the visible part."""
    lower = dataclasses.replace(box(z=0.02), name="lower")
    down = np.eye(4)
    down[2, 3] = 0.01
    localizations = find(pictures, lower, starts(POSE @ down))
    assert not localizations.accepted


def test_the_corner_of_another_block_is_not_accepted():
    """All that is seen of the box is exact, and the rest is missing, as if something hid it."""
    (localization, *_) = find(drawn(box(0.06, 0.03, 0.03), views(), POSE, 0.03))
    assert 0.5 < localization.verdict.evidence.explained < 0.82
    assert localization.verdict.decision == "open"
    assert f"moving face {BACK} inward by 10 mm" in localization.message


def test_a_hidden_object_is_accepted():
    """A round spot hides the middle of each view; no face is found elsewhere."""
    pictures = []
    middles = projected(views(), MIDDLE[None])[:, 0]
    for own, middle in zip(drawn(MODEL, views(), POSE, 0.03), middles, strict=True):
        free = np.linalg.norm(own.pixels - middle, axis=1) > 110.0
        pictures.append(EdgePoints(*(part[free] for part in own)))
    (localization, *_) = find(pictures)
    assert 0.5 < localization.verdict.evidence.explained < 0.82
    assert localization.verdict.evidence.moved.gained_px < 60.0
    assert localization.verdict.decision == "accepted"


def test_of_two_models_the_right_one_is_accepted(pictures):
    lower = dataclasses.replace(box(z=0.02), name="lower")
    down = np.eye(4)
    down[2, 3] = 0.01
    localizations = find(pictures, [lower, MODEL], starts(POSE @ down) + starts(model=1))
    assert [localization.model.name for localization in localizations.accepted] == ["box"]
    assert "lower: not found" in localizations.messages[0]


def test_of_two_models_that_explain_as_much_the_more_exact_one_is_accepted(pictures):
    """A larger box has an edge point near each of its own, but not on it.

    Their sizes are so near that it explains more, so that it is judged first.
    """
    larger = box(1.003 * 0.06, 1.003 * 0.04, 1.003 * 0.03)
    larger = dataclasses.replace(larger, name="larger", symmetry=find_symmetry(larger))
    localizations = find(pictures, [MODEL, larger], starts() + starts(model=1))
    (localization,) = localizations.accepted
    assert localization.model.name == "box"
    of_box, (rival, *_) = localization.verdict.evidence, localization.rivals
    assert of_box.log_likelihood < rival.log_likelihood + 6.0
    assert localization.verdict.margin > 6.0
    assert rival.model == 1


def test_clutter_alone_is_nothing():
    localizations = find(clutter(np.random.default_rng(0), 20))
    assert not localizations.accepted
    assert localizations.messages


def test_empty_pictures_are_no_object():
    empty = [
        EdgePoints(*(part[:0] for part in picture)) for picture in clutter(np.random.default_rng(0))
    ]
    localizations = find(empty)
    assert not len(localizations)
    assert localizations.messages == ("box: not found: 3 hypotheses, none with enough edges",)


def test_two_instances_are_both_found():
    shifted = POSE.copy()
    shifted[:3, 3] += [-0.08, 0.03, 0.0]
    poses = poses_of_both(POSE[:3, :3].T @ [-0.08, 0.03, 0.0])
    seen = sv.modeling.SeenViews.of(CALIBRATION, poses)
    pictures = together(drawn(MODEL, seen, POSE, 0.1), drawn(MODEL, seen, shifted, 0.1))
    localizations = find(pictures, hypotheses=starts(shifted) + starts(), poses=poses)
    assert len(localizations.accepted) == 2
    middles = np.array(
        [
            localization.world_from_object @ [*MODEL.vertices.mean(axis=0), 1.0]
            for localization in localizations
        ]
    )
    assert abs(np.linalg.norm(middles[0] - middles[1]) - np.linalg.norm([0.08, 0.03])) < 1e-4


def test_half_outside_the_picture_is_not_certain():
    across = views().camera_from_world[0, 0, :3]
    poses = poses_towards(MIDDLE + 0.085 * across, TWO_DIRECTIONS[:1])
    seen = sv.modeling.SeenViews.of(CALIBRATION, poses)
    localizations = find(drawn(MODEL, seen, POSE, 0.1), poses=poses)
    assert not localizations.accepted


def test_pictures_in_one_direction_count_as_one(found):
    """A second picture from the same place tells of the object's size no more than the first."""
    first = TWO_DIRECTIONS[0] / np.linalg.norm(TWO_DIRECTIONS[0])
    across = np.cross(first, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    for degrees, is_alone in ((1.8, True), (2.2, False)):
        second = first + np.tan(np.deg2rad(degrees)) * across
        poses = poses_towards(MIDDLE, np.stack([first, second]))
        seen = sv.modeling.SeenViews.of(CALIBRATION, poses)
        own = find(drawn(MODEL, seen, POSE, 0.1), poses=poses)
        assert own[0].verdict.evidence.is_alone == is_alone
    assert not found[0].verdict.evidence.is_alone


def test_a_picture_given_twice_is_refused(pictures, found):
    """It would be counted as a second witness; a camera that hangs gives the same one again."""
    given = evidence(pictures)
    with pytest.raises(ValueError, match=r"^views 0 and 2: the same picture, given twice$"):
        localize([*given, given[0]], POSES[[0, 1, 0]], CALIBRATION, MODEL)
    with pytest.raises(ValueError, match=r"^views 1 and 2: the same picture, given twice$"):
        localize(given[1:], POSES[:1], CALIBRATION, MODEL, previous=found)


@pytest.fixture(scope="module")
def first(pictures):
    """What is found in the first picture alone."""
    return localize(evidence(pictures[:1]), POSES[:1], CALIBRATION, MODEL, hypotheses=starts())


def test_a_further_view_counts_together_with_the_first(pictures, found, first):
    both = localize(evidence(pictures[1:]), POSES[1:], CALIBRATION, MODEL, previous=first)
    assert len(both.pictures) == 2
    np.testing.assert_allclose(both[0].world_from_object, found[0].world_from_object, atol=2e-5)
    sizes = [np.sqrt(np.linalg.eigvalsh(x[0].covariance)[-1]) for x in (first, both)]
    assert sizes[1] < 0.8 * sizes[0]


def test_earlier_views_are_not_read_again_with_another_calibration(pictures, first):
    camera = eqx.tree_at(lambda tree: tree.alpha_u, CALIBRATION.camera, 1400.0)
    wider = sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    moved = sv.Calibration.eye_in_hand(
        CALIBRATION.camera, host_exponentials(np.array([0.01, 0, 0, 0, 0, 0])), np.eye(4)
    )
    for other, difference in (
        (wider, "with alpha_u 1500, not 1400"),
        (moved, "camera poses that differ by up to 10 mm in translation"),
    ):
        with pytest.raises(ValueError, match=f"^previous: its views .*, {difference}; give"):
            localize(evidence(pictures[1:]), POSES[1:], other, MODEL, previous=first)


def test_a_model_that_earlier_views_do_not_show_is_searched_for_again(monkeypatch):
    solid = prism(6)
    other = dataclasses.replace(solid, name="prism", symmetry=find_symmetry(solid))
    second_pose = POSE @ host_exponentials(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    poses = poses_of_both([0.1, 0.0, 0.0])
    seen = sv.modeling.SeenViews.of(CALIBRATION, poses)
    box_alone = drawn(MODEL, seen, POSE, 0.1)
    both = together(box_alone, drawn(other, seen, second_pose, 0.1))
    # Something is before the prism in the first picture.
    first = localize(
        evidence(box_alone[:1]), poses[:1], CALIBRATION, [MODEL, other], hypotheses=starts()
    )
    assert {localization.model.name for localization in first} == {"box"}

    few = SearchOptions(polished=7)

    def find_hypotheses(pictures, views, models, count, *, workspace, options):
        assert [model.name for model in models] == ["prism"]
        assert options is few
        assert count == 4 * 7
        assert len(pictures) == 2
        return starts(second_pose)

    monkeypatch.setattr(search_rounds, "find_hypotheses", find_hypotheses)
    localizations = localize(
        evidence(both[1:]), poses[1:], CALIBRATION, [MODEL, other], previous=first, search=few
    )
    names = {(obj.model.name, obj.model_index) for obj in localizations}
    assert names == {("box", 0), ("prism", 1)}


def test_views_with_and_without_joint_readings_go_together(pictures):
    poses = host_transforms(POSES)
    first = localize(
        evidence(pictures[:1]),
        Command(jax.tree.map(lambda x: x[:1], poses), jnp.zeros((1, 6))),
        CALIBRATION,
        MODEL,
        hypotheses=starts(),
    )
    both = localize(evidence(pictures[1:]), POSES[1:], CALIBRATION, MODEL, previous=first)
    assert len(both.pictures) == 2
    assert both.command.joints is None


def test_bad_input_is_named(pictures):
    with pytest.raises(ValueError, match="workspace: expected two corners"):
        find(pictures, workspace=np.full((2, 3), np.nan))
    with pytest.raises(ValueError, match=r"workspace: expected two corners .*, m, up to 100"):
        find(pictures, workspace=np.array([[-200.0, -200.0, 0.0], [200.0, 200.0, 150.0]]))
    with pytest.raises(ValueError, match=r"occluders: expected metres, up to 100 m .*; found 500"):
        find(pictures, occluders=500.0 * np.eye(3)[None])
    millimetres = np.array(POSES)
    millimetres[:, :3, 3] *= 1e3
    with pytest.raises(ValueError, match=r"view 0: the tool is .* m from the base: .*millimetres"):
        find(pictures, poses=millimetres)
    with pytest.raises(ValueError, match="hypotheses: of model 1, where there are 1 models"):
        find(pictures, hypotheses=starts(model=1))
    edgeless = ObjectModel(MODEL.vertices, name="points")
    with pytest.raises(ValueError, match="model 0 'points' has no edges"):
        find(pictures, edgeless)
    with pytest.raises(ValueError, match="2 pictures and 1 poses; view 1"):
        find(pictures, poses=POSES[:1])
    with pytest.raises(ValueError, match="at least one, found none"):
        find(pictures, [])
    with pytest.raises(ValueError, match="one for each view"):
        localize([], POSES, CALIBRATION, MODEL)
    blank = np.full(IMAGE_SIZE[::-1], 90, np.uint8)
    with pytest.raises(ValueError, match="view 0: picture: blank"):
        localize([blank, blank], POSES, CALIBRATION, MODEL)
    with pytest.raises(ValueError, match="view 1: picture: over-exposed"):
        localize([evidence(pictures)[0], blank + np.uint8(165)], POSES, CALIBRATION, MODEL)


def test_other_kinds_of_input_are_named(monkeypatch):
    """Without the tests' checks of types, by which such kinds are refused before."""
    module = sys.modules["smartview_jax.localization.localize"]
    for name in ("_evidence", "_checked_views"):
        monkeypatch.setattr(module, name, inspect.unwrap(getattr(module, name)))
    unchecked, pose = inspect.unwrap(localize), np.eye(4)[None]
    said = "view 0: expected a picture, or what picture_evidence found in it; found str"
    with pytest.raises(ValueError, match=f"^{said}$"):
        unchecked(["a.png"], pose, CALIBRATION, MODEL)
    said = "calibration: expected a Calibration, .*, or RigViews that name .*; found NoneType"
    with pytest.raises(ValueError, match=f"^{said}$"):
        unchecked([np.zeros(IMAGE_SIZE[::-1], np.uint8)], pose, None, MODEL)


def test_the_papers_view_looks_along_the_top_surface(found):
    chosen = next_view(found, CALIBRATION, Reachable(distance=0.4))
    assert chosen.paper is not None
    up = POSE[:3, 2]
    np.testing.assert_allclose(chosen.paper.camera_from_world[2, :3], -up, atol=1e-3)
    assert chosen.gain >= chosen.paper.gain
    assert "the paper's view" in chosen.reason
    assert chosen.position_std[1] < chosen.position_std[0]


def test_the_view_that_tells_rivals_apart_is_chosen(pictures):
    """From above the boxes look alike; their heights are seen from the side."""
    lower = dataclasses.replace(box(z=0.02), name="lower")
    down = np.eye(4)
    down[2, 3] = 0.01
    localizations = find(pictures, [MODEL, lower], starts() + starts(POSE @ down, model=1))
    verdict = localizations[0].verdict._replace(decision="open", margin=1.0)
    own = verdict.evidence
    rival = (
        localizations[0]
        .rivals[0]
        ._replace(log_likelihood=own.log_likelihood - 1.0, log_exactness=own.log_exactness)
    )
    open_one = localizations[0]._replace(verdict=verdict, rivals=(rival,))
    up = POSE[:3, 2]
    side = np.cross(up, [1.0, 0.2, 0.0])
    looks = poses_towards(MIDDLE, np.array([-up, -(0.35 * up + side)]))
    candidates = np.linalg.inv(looks)
    chosen = next_view([open_one], CALIBRATION, Reachable(candidates), models=[MODEL, lower])
    np.testing.assert_allclose(chosen.camera_from_world, candidates[1])
    assert chosen.discrimination > chosen.paper.discrimination
    assert "from 1 remaining rival" in chosen.reason


def test_the_predicted_covariance_is_that_of_the_view(first):
    second = Reachable(np.linalg.inv(POSES[1:]), distance=0.4)
    chosen = next_view(first, CALIBRATION, second)
    pose = np.linalg.inv(chosen.camera_from_world)[None]
    seen = sv.modeling.SeenViews.of(CALIBRATION, pose)
    after = localize(
        evidence(drawn(MODEL, seen, POSE, 0.1)), pose, CALIBRATION, MODEL, previous=first
    )
    p = MODEL.vertices.mean(axis=0)
    shift = np.eye(6)
    shift[:3, 3:] = -np.array([[0, -p[2], p[1]], [p[2], 0, -p[0]], [-p[1], p[0], 0]])
    own = shift @ after[0].covariance @ shift.T
    std = np.sqrt(np.linalg.eigvalsh(own[:3, :3])[-1])
    assert chosen.position_std[1] < 0.7 * chosen.position_std[0]
    assert 0.6 < std / chosen.position_std[1] < 1.6


def test_the_robots_noise_makes_a_view_tell_less(found):
    exact, noisy = (
        next_view(found, CALIBRATION, Reachable(distance=0.4), noise=noise)
        for noise in (None, Noise(0.1, 3e-4, 1e-3))
    )
    assert noisy.position_std[1] > 1.2 * exact.position_std[1]


def test_no_view_is_an_error(found):
    away = np.linalg.inv(poses_towards(MIDDLE + np.array([1.0, 0.0, 0.0]), TWO_DIRECTIONS))
    off_picture = Reachable(away, limits=sv.viewpoints.Limits())
    with pytest.raises(ValueError, match="nothing was found"):
        next_view([], CALIBRATION, Reachable(distance=0.4))
    with pytest.raises(ValueError, match="a distance"):
        next_view(found, CALIBRATION, Reachable())
    wall = sv.viewpoints.Limits(focus_range=(0.01, 0.02))
    with pytest.raises(ValueError, match=r"none of 6 views: .*too far to be sharp"):
        next_view(found, CALIBRATION, off_picture._replace(limits=wall))
