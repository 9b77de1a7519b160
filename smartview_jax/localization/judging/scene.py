"""Keep track of the edge points that no object explains yet, and of known occluding surfaces."""

import copy
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...features import PictureEvidence, evidence_of_points
from ...modeling import SeenViews
from ..edges import EXPLAINED_DISTANCE, DepthBuffers, EdgeLines, EdgeLookup, Wireframe
from ..refining import explained_edge_points, measured_lines


class Claim(NamedTuple):
    """The parts of the pictures that an object takes away from all others.

    Attributes:
        free: for each view, which edge points it does not explain.
        inverse_depth: of the nearest known surface, including its own, in each cell of each view,
            1/m; zero where none is known.
    """

    free: list[Bool[np.ndarray, "_"]]
    inverse_depth: Float[np.ndarray, "views rows columns"]


class Scene:
    """The pictures of one scene, and the edge points that no object explains yet.

    Attributes:
        views: camera and poses.
        pictures: features and edge points of each picture.
        lookup: the free edge points, and the occluding surfaces.
    """

    def __init__(
        self,
        views: SeenViews,
        pictures: Sequence[PictureEvidence],
        occluders: Float[np.ndarray, "triangles 3 3"],
    ):
        self.views, self.pictures, self._occluders = views, pictures, occluders
        self._surfaces = DepthBuffers(views)
        self._surfaces.add_triangles(occluders)
        self._claims: list[Claim] = []
        self.lookup: EdgeLookup = self.lookup_among(self._claims)

    @property
    def has_claims(self) -> bool:
        """Whether an object has taken edge points."""
        return bool(self._claims)

    def seen_by(self, views: SeenViews) -> "Scene":
        """Return the untouched scene of the same pictures, taken by other cameras or poses."""
        return Scene(views, self.pictures, self._occluders)

    def untouched(self) -> "Scene":
        """Return the scene before any object took edge points."""
        scene = copy.copy(self)
        scene._claims = []
        scene.lookup = scene.lookup_among(scene._claims)
        return scene

    def claim(
        self,
        lines: EdgeLines,
        wireframe: Wireframe | None = None,
        pose: Float[np.ndarray, "4 4"] | None = None,
    ) -> Claim:
        """Return the parts of the pictures that an object takes away from the others.

        Args:
            lines: edge points that it explains.
            wireframe, pose: of an object that occludes others.
        """
        surfaces = self._surfaces
        if wireframe is not None and pose is not None:
            surfaces = surfaces.copy()
            surfaces.add(wireframe, pose)
        free = []
        for view, picture in enumerate(self.pictures):
            is_free = np.ones(len(picture.edge_points.pixels), dtype=bool)
            is_free[explained_edge_points(lines, view, picture.edge_points)] = False
            free.append(is_free)
        return Claim(free, surfaces.inverse_depth)

    def take(self, claim: Claim) -> None:
        """Take the edge points that an object explains, and the parts it hides, from the others."""
        self._claims.append(claim)
        self.lookup = self.lookup_among(self._claims)

    def lookup_among(self, claims: Sequence[Claim]) -> EdgeLookup:
        """Return the edge points that some objects leave free, and the occluding surfaces."""
        free = self._free(claims)
        depths = [self._surfaces.inverse_depth, *(claim.inverse_depth for claim in claims)]
        return EdgeLookup.of(
            [picture.edge_points for picture in self.pictures],
            self.views.largest_picture,
            free,
            np.maximum.reduce(depths),
            [picture.lone for picture in self.pictures],
            [picture.correlated_length for picture in self.pictures],
            [picture.gradient_sigma for picture in self.pictures],
        )

    def _free(self, claims: Sequence[Claim]) -> list[Bool[np.ndarray, "_"]]:
        """Return which edge points of each picture some objects leave free."""
        return [
            np.logical_and.reduce([np.ones(len(picture.edge_points.pixels), bool), *claimed])
            for picture, *claimed in zip(
                self.pictures, *(claim.free for claim in claims), strict=True
            )
        ]

    def free_pictures(self) -> list[PictureEvidence]:
        """Return the pictures without the segments along edge points that are taken."""
        return [
            evidence_of_points(picture, free, camera)
            for picture, free, camera in zip(
                self.pictures, self._free(self._claims), self.views.cameras, strict=True
            )
        ]

    def lines(
        self,
        pose: Float[np.ndarray, "4 4"],
        wireframe: Wireframe,
        views: SeenViews | None = None,
    ) -> EdgeLines:
        """Return the free edge points along the edges at a pose, also in corrected views."""
        views = self.views if views is None else views
        return measured_lines(wireframe, views, self.lookup, pose, EXPLAINED_DISTANCE)


def explained_among(lines: EdgeLines, usable: Sequence[Bool[np.ndarray, "_"]]) -> float:
    """Return the length that lines explain with usable edge points, all views together, px."""
    total = 0.0
    for view, is_usable in enumerate(usable):
        has_edge = np.isfinite(lines.distances[view])
        kept = is_usable[lines.points[view][has_edge]]
        total += float(lines.sample_px[view][has_edge][kept].sum())
    return total
