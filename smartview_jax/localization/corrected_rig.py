"""Judge a scene again with the camera poses that its objects show, where the given ones are off."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..features import PictureEvidence
from ..modeling import SeenViews
from .candidates import Query
from .corrected_views import corrected_views
from .hypotheses import Hypothesis
from .localization import Localization
from .rig_noise import ViewDisagreement
from .scene import Scene
from .search_rounds import SearchResult, judged_in_rounds
from .views_alone import noise_of_rig

SearchIn = Callable[[SeenViews, Sequence[PictureEvidence], Sequence[int]], list[Hypothesis]]
"""Return the hypotheses of some models, given by their indices, in pictures of some views."""


class JudgedScene(NamedTuple):
    """The verdicts on a scene, with the views and the uncertainty for which they hold.

    Attributes:
        result: verdicts, and where the search ended.
        scene: pictures, and views with the likeliest camera poses.
        query: with the uncertainty of these views.
    """

    result: SearchResult
    scene: Scene
    query: Query


def judged_with_rig(
    result: SearchResult,
    scene: Scene,
    query: Query,
    searched: Sequence[int],
    search: SearchIn,
    occluders: Float[np.ndarray, "triangles 3 3"],
) -> JudgedScene:
    """Return the verdicts on a scene, the camera poses having been checked on all its objects.

    Where the objects show that these are off beyond what is stated, the views are corrected by the
    likeliest errors, whose size widens the covariances of all poses. The poses that were found
    are judged again in the corrected views, and models without a pose are searched again.

    Args:
        result: verdicts with the views as given.
        scene: pictures and views as given.
        query: what is looked for, with the uncertainty of these views.
        searched: indices of the models that may be searched again.
        search: how they are.
        occluders: triangles of known obstacles in the world, m.
    """
    noise = noise_of_rig(result.results, result.first, scene, query)
    disagreement = None if noise is None else noise.disagreement
    if noise is None or not noise.disagreement.is_likely:
        return JudgedScene(
            result._replace(results=_with_disagreement(result.results, disagreement)), scene, query
        )
    uncertainty = query.uncertainty.with_view_errors(noise.translation, noise.rotation)
    errors = np.concatenate([np.zeros(len(query.uncertainty.names)), noise.errors.ravel()])
    views = corrected_views(scene.views, uncertainty, errors)
    scene = Scene(views, scene.pictures, occluders)
    query = query._replace(uncertainty=uncertainty, disagreement=disagreement)
    known = {obj.model_index for obj in result.results if obj.verdict.decision != "rejected"}

    def search_again(
        pictures: Sequence[PictureEvidence], indices: Sequence[int]
    ) -> list[Hypothesis]:
        return search(views, pictures, indices)

    again = judged_in_rounds(
        scene,
        query,
        [*_hypotheses_of(result.results), *(h for h in result.first if h.model not in known)],
        [k for k in searched if k not in known],
        search_again,
    )
    again = again._replace(results=_with_disagreement(again.results, disagreement))
    return JudgedScene(again, scene, query)


def _with_disagreement(
    results: Sequence[Localization], disagreement: ViewDisagreement | None
) -> list[Localization]:
    """Return results whose evidence contains the disagreement of the views."""
    changed = []
    for obj in results:
        evidence = obj.verdict.evidence._replace(disagreement=disagreement)
        changed.append(obj._replace(verdict=obj.verdict._replace(evidence=evidence)))
    return changed


def _hypotheses_of(results: Sequence[Localization]) -> list[Hypothesis]:
    """Return the poses of results and of their rivals."""
    poses = [(obj.model_index, obj.world_from_object) for obj in results]
    poses += [(rival.model, rival.world_from_object) for obj in results for rival in obj.rivals]
    return [Hypothesis(model, pose, 0.0, 0.0) for model, pose in poses]
