"""Long bars, bars side by side, and more objects than one round of the search tries."""

import dataclasses

import numpy as np
import pytest
from drawn_edges import (
    TWO_DIRECTIONS,
    calibration,
    drawn,
    evidence,
    poses_towards,
    seen_views,
    together,
)
from placed_box import MODEL, POSE
from solids import box

from smartview_jax.geometry import host_exponentials
from smartview_jax.localization import Hypothesis, localize, search_rounds
from smartview_jax.localization.edges.wireframe import MIN_EDGE_SAMPLES, Wireframe
from smartview_jax.localization.judging.scene import Scene
from smartview_jax.localization.refining.refinement import explained_edge_points, measured_lines
from smartview_jax.modeling import find_symmetry

BAR = box(0.15, 0.01, 0.014, name="bar")
BAR = dataclasses.replace(BAR, symmetry=find_symmetry(BAR))
CUBE = box(0.02, 0.016, 0.012, name="cube")
CUBE = dataclasses.replace(CUBE, symmetry=find_symmetry(CUBE))


def at(x, y):
    return host_exponentials(np.array([x, y, 0.0, 0.0, 0.0, 0.0]))


def starts(places):
    """Hypotheses near poses."""
    off = host_exponentials(np.array([5e-4, -5e-4, 3e-4, 3e-3, -3e-3, 3e-3]))
    return [Hypothesis(0, pose @ off, 0.0, 0.0) for pose in places]


def found_among(model, places, distance, hypotheses=None):
    """What is found in two pictures of all objects; by a search, unless hypotheses are given."""
    aim = np.mean([pose[:3, 3] for pose in places], axis=0) + model.vertices.mean(axis=0)
    views = seen_views(aim, TWO_DIRECTIONS, distance)
    rng = np.random.default_rng(0)
    pictures = together(*(drawn(model, views, pose, 0.05, rng) for pose in places))
    poses = poses_towards(aim, TWO_DIRECTIONS, distance)
    return localize(evidence(pictures), poses, calibration(), model, hypotheses=hypotheses)


def test_a_short_edge_of_a_long_bar_has_enough_samples():
    wireframe = Wireframe.of(BAR)
    lengths = np.asarray(wireframe.sample_lengths)
    counts = np.bincount(np.asarray(wireframe.sample_edges)[lengths > 0.0])
    # As many as before, with most of them still on the long edges.
    assert len(lengths) == 128
    assert counts.min() == MIN_EDGE_SAMPLES
    assert counts.max() > 3 * MIN_EDGE_SAMPLES
    assert lengths.sum() == pytest.approx(4 * (0.15 + 0.01 + 0.014))


def test_two_bars_side_by_side_are_both_found():
    places = [at(0.0, 0.0), at(0.0, 0.025)]
    localizations = found_among(BAR, places, 0.55, starts(places))
    assert [obj.verdict.decision for obj in localizations] == ["accepted"] * 2, (
        localizations.messages
    )
    middles = [obj.world_from_object @ [*BAR.vertices.mean(axis=0), 1.0] for obj in localizations]
    assert abs(middles[0] - middles[1])[:3] == pytest.approx([0.0, 0.025, 0.0], abs=2e-4)
    assert localizations.messages == ()


def test_all_of_many_objects_are_found_by_two_searches(monkeypatch):
    """More than are rejected in a row, and more than one search has proposals for."""
    places, searches = [at(0.034 * i, 0.03 * j) for i in range(5) for j in range(2)], []
    monkeypatch.setattr("smartview_jax.localization.judging.judging.MAX_REJECTED", 6)

    def find_hypotheses(pictures, views, models, count, *, workspace, options):
        searches.append(pictures)
        return starts(places[: search_rounds.SEARCHED_AGAIN] if len(searches) == 1 else places)

    monkeypatch.setattr(search_rounds, "find_hypotheses", find_hypotheses)
    localizations = found_among(CUBE, places, 0.6)
    assert len(localizations.accepted) == len(places)
    assert localizations.messages == ()
    assert len(searches) == 2


def test_points_between_distant_samples_are_explained_too(views):
    pictures = drawn(MODEL, views, POSE, 0.05)
    scene = Scene(views, evidence(pictures), np.zeros((0, 3, 3)))
    shares = []
    for samples in (64, 512):
        lines = measured_lines(Wireframe.of(MODEL, samples), views, scene.lookup, POSE, 2.0)
        counts = [len(explained_edge_points(lines, k, pictures[k])) for k in range(2)]
        shares.append(sum(counts) / sum(len(points.pixels) for points in pictures))
    assert min(shares) > 0.97
