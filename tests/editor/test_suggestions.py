from collections import Counter

import numpy as np
import pytest
from scipy.optimize import root_scalar
from scipy.stats import norm
from sessions import click_all, open_session

from smartview_jax.editor.conversation import Conversation


def with_edges(scene, ids, session):
    for a, b in scene.truth.edges:
        session.add_edge(ids[a], ids[b])


def is_true(scene, ids, suggestion):
    ends = [[ids.index(point) for point in pair] for pair in suggestion.items]
    u, v = (np.subtract(*scene.truth.vertices[pair]) for pair in ends)
    lengths = np.linalg.norm(u), np.linalg.norm(v)
    deviation = {
        "equal_length": lengths[0] - lengths[1],
        "right_angle": u @ v,
        "parallel": np.linalg.norm(np.cross(u, v)),
    }
    return abs(deviation[suggestion.kind]) < 1e-9


def test_the_odds_of_two_equal_edges_are_a_likelihood_ratio_times_the_share(scene):
    session = open_session(scene)
    ids = click_all(session, scene)
    pairs = [(ids[0], ids[5]), (ids[1], ids[6])]
    for pair in pairs:
        session.add_edge(*pair)
    (suggestion,) = (
        suggestion for suggestion in session.suggestions() if suggestion.kind == "equal_length"
    )
    (a, sigma_a), (b, sigma_b) = session.distances(pairs)
    assert suggestion.deviation == pytest.approx(abs(a - b), rel=1e-9)
    assert suggestion.sigma == pytest.approx(np.hypot(sigma_a, sigma_b), rel=1e-6)
    # If they are unrelated any difference up to the longer one is as likely.
    ratio = norm.pdf(a - b, scale=suggestion.sigma) * max(a, b)

    def excess(share):
        probability = share * ratio / (share * ratio + 1.0 - share)
        return (1.0 + probability) / 3.0 - share

    share = root_scalar(excess, bracket=(0.1, 0.9)).root
    assert suggestion.odds == pytest.approx(ratio * share / (1.0 - share), rel=1e-6)


def test_what_is_suggested_of_a_house_is_true_and_is_stated_as_by_hand(scene):
    session = open_session(scene, click_sigma=0.3)
    ids = click_all(session, scene)
    with_edges(scene, ids, session)
    offered = session.suggestions()
    count = Counter(suggestion.kind for suggestion in offered)
    # Only what does not follow from others: in five directions 15 edges have 10 parallels, and five
    # right angles. The lengths are four.
    assert (count["parallel"], count["right_angle"]) == (10, 5)
    assert 5 <= count["equal_length"] <= 11
    # Nothing is assumed unasked.
    assert not session.document.constraints
    for _ in range(6):
        verdict = Conversation(session).judge()["suggestions"]
        assert all(is_true(scene, ids, suggestion) for suggestion in session.suggestions())
        facts = [
            {"kind": suggestion["kind"], "items": suggestion["items"]}
            for suggestion in verdict[::2]
        ]
        changes = [{"do": "add_constraint", **fact} for fact in facts]
        session.change({"do": "several", "changes": changes})
    # They hold together, and what they imply is not asked again.
    assert session.suggestions() == []
    assert not any(estimate.failure for estimate in session.estimates().values())
    assert session.undo()


def test_little_is_suggested_of_a_stone(scene):
    """Whose edges have nothing to do with each other, so that any relation is a coincidence."""
    offered, pairs = 0, 0
    for seed in range(3):
        rng = np.random.default_rng(seed)
        session = open_session(scene, click_sigma=0.3)
        vertices = rng.uniform([-0.03, -0.03, 0.0], [0.03, 0.03, 0.03], (8, 3))
        pixels = np.stack(
            [
                session.calibration.camera.project(vertices @ view[:3, :3].T + view[:3, 3])[0]
                for view in session.geometry.camera_from_world
            ]
        )
        pixels += 0.3 * rng.standard_normal(pixels.shape)
        clicks = [dict(zip(session.names, p.tolist(), strict=True)) for p in pixels.swapaxes(0, 1)]
        points = [{"do": "add_point", "clicks": clicked} for clicked in clicks]
        edges = [
            {"do": "add_edge", "ends": [k, (k + step) % 8]} for k in range(8) for step in (1, 3)
        ]
        session.change({"do": "several", "changes": [*points, *edges]})
        offered += len(session.suggestions())
        pairs += len(edges) * (len(edges) - 1) // 2
    # At odds of 20 to one, and chance being weighed by what the object itself shows.
    assert offered <= 1 < pairs / 300
