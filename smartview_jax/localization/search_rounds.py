"""Try hypotheses in rounds, until a round brings no further object.

In most scenes the first few hypotheses contain all objects. Where there are many objects, those
that are found take their edge points away, and the next hypotheses are tried on what is left. Where
one search has found very many, what is left is searched again.
"""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .judging import (
    Candidate,
    Localization,
    Query,
    Scene,
    converged_candidates,
    judged,
    measured_candidates,
    scene_without,
)
from .refining import lengths_of_poses
from .search import Hypothesis, find_hypotheses

SEARCHED_AGAIN = 8
"""Number of objects of a model that one search finds, from which on it is searched for again.

A search polishes `SearchOptions.polished` proposals, and several of them are of one object.
"""


class SearchResult(NamedTuple):
    """The verdicts on a scene, and where the search ended.

    Attributes:
        results: verdicts.
        tried: number of hypotheses of each model that were tried.
        unjudged: number of poses of each model that might be objects, but were not judged.
        first: hypotheses of the first round, the best first.
    """

    results: list[Localization]
    tried: list[int]
    unjudged: list[int]
    first: list[Hypothesis]


def judged_in_rounds(
    scene: Scene,
    query: Query,
    given: Sequence[Hypothesis],
    searched: Sequence[int],
) -> SearchResult:
    """Return the verdicts on hypotheses, round after round until one brings no further object.

    Args:
        scene: edge points of the pictures, from which found objects take theirs.
        query: what is looked for.
        given: hypotheses that are all tried in the first round.
        searched: indices of the models that are searched for.
    """
    prepared = query.models
    tried, unjudged = [0] * len(prepared), [0] * len(prepared)
    results: list[Localization] = []
    accepted: list[Localization] = []
    first: list[Hypothesis] = []
    waiting = _found_in(scene, query, searched)
    # Objects of each model: found by the latest search, and in the last round.
    by_search: Counter[int] = Counter()
    by_round: Counter[int] = Counter(range(len(prepared)))
    while True:
        free = scene_without(scene, prepared, accepted)
        # There may be more objects only of models that the last round found.
        waiting = _worth_trying(free, query, [h for h in waiting if by_round[h.model]])
        many = [model for model in searched if by_search[model] >= SEARCHED_AGAIN]
        if many and not waiting:
            waiting = _worth_trying(free, query, _found_in(free, query, many))
            by_search.clear()
        batch, waiting = _first_of_each_model(waiting, query.search.hypotheses)
        batch, given = [*given, *batch], ()
        if not batch:
            return SearchResult(results, tried, unjudged, first)
        first = first or batch
        tried = _added(tried, batch)
        candidates = _within(converged_candidates(free, query, batch), query)
        # Poses left open are judged again, with the objects found since as neighbours.
        undecided = [obj for obj in results if obj.verdict.decision == "open"]
        if undecided:
            poses = [(c.model, c.pose) for c in candidates]
            poses += [(obj.model_index, obj.world_from_object) for obj in undecided]
            candidates = measured_candidates(free, query, poses)
        rejected = [obj for obj in results if obj.verdict.decision == "rejected"]
        judgement = judged(free, query, candidates, sum(tried), accepted)
        unjudged = _added(unjudged, judgement.unjudged)
        results = [*judgement.results, *rejected]
        now = [obj for obj in results if obj.accepted]
        by_round = Counter(
            obj.model_index for obj in now if not any(obj is other for other in accepted)
        )
        by_search += by_round
        accepted = now


def hypotheses_of(results: Sequence[Localization]) -> list[Hypothesis]:
    """Return the poses of results and of their rivals, to be tried again."""
    poses = [(obj.model_index, obj.world_from_object) for obj in results]
    poses += [(rival.model, rival.world_from_object) for obj in results for rival in obj.rivals]
    return [Hypothesis(model, pose, 0.0, 0.0) for model, pose in poses]


def _found_in(scene: Scene, query: Query, indices: Sequence[int]) -> list[Hypothesis]:
    """Return the hypotheses of some models by the free edges of a scene, the best first."""
    if not indices:
        return []
    models = [query.models[k].model for k in indices]
    pictures = scene.free_pictures() if scene.has_claims else scene.pictures
    options, workspace = query.search, query.workspace
    hypotheses = find_hypotheses(
        pictures, scene.views, models, options.all_hypotheses, workspace=workspace, options=options
    )
    return [h._replace(model=indices[h.model]) for h in hypotheses]


def _first_of_each_model(
    hypotheses: Sequence[Hypothesis], most: int
) -> tuple[list[Hypothesis], list[Hypothesis]]:
    """Return the hypotheses of a round, and the others."""
    counts: Counter[int] = Counter()
    batch, others = list[Hypothesis](), list[Hypothesis]()
    for hypothesis in hypotheses:
        counts[hypothesis.model] += 1
        is_first = counts[hypothesis.model] <= most
        (batch if is_first else others).append(hypothesis)
    return batch, others


def _worth_trying(scene: Scene, query: Query, hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the hypotheses that might be accepted by the edge points that are still free."""
    if not scene.has_claims:
        return list(hypotheses)
    kept = []
    for index, entry in enumerate(query.models):
        waiting = [h for h in hypotheses if h.model == index]
        if not waiting:
            continue
        poses = np.stack([h.world_from_object for h in waiting])
        visible, explained = lengths_of_poses(entry.coarse, scene.views, scene.lookup, poses).T
        is_kept = explained >= query.options.hidden_share * np.maximum(visible, 1.0)
        kept += [h for h, keep in zip(waiting, is_kept, strict=True) if keep]
    return kept


def _within(candidates: Sequence[Candidate], query: Query) -> list[Candidate]:
    """Return the candidates whose middle is in the workspace.

    Checked again after the fit, which may have moved a pose out of the box. Only the middle is
    checked: the vertices were when the pose was proposed, and the walls are not exact.
    """
    box = query.workspace
    if box is None:
        return list(candidates)
    middles = [query.models[c.model].middle_at(c.pose) for c in candidates]
    inside = [bool(((box[0] <= m) & (m <= box[1])).all()) for m in middles]
    return [c for c, is_in in zip(candidates, inside, strict=True) if is_in]


def _added(counts: Sequence[int], of_models: Sequence[Hypothesis | Candidate]) -> list[int]:
    """Return numbers by model, with further hypotheses or candidates counted in."""
    more = Counter(entry.model for entry in of_models)
    return [count + more[model] for model, count in enumerate(counts)]
