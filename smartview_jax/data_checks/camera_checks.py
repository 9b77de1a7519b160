"""Check whether one camera fits the views by itself, before the robot's poses are asked.

A lens model that cannot bend as the lens does moves the pose of every view, and then robot and
camera do not move alike although the robot is right. So the views are asked alone: each is fitted
with a camera of its own, by any lens that is symmetric about its axis. Where that leaves far less
than the common camera with a free pose in every view, the common camera is wrong, and other lens
models of the package are tried.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Int

from ..cameras import AbstractLens, Camera, lens_name
from ..dataset import Observations, camera_residuals, evenly_spaced, medians_by_view
from ..geometry import host_matrices
from .target_checks import DETECTION_NOISE, fit_of_any_lens, median_distance

MAX_MISFIT_RATIO = 0.3
"""Ratio of two misfits below which the first counts as an explanation of most of the second."""

MAX_RIVAL_RATIO = 2.0
"""Ratio of two misfits up to which the first is about as small as the second."""

MAX_ASKED_VIEWS = 12
"""Largest number of views that are fitted with cameras of their own; their median is enough."""

TRIED_LENSES = ("opencv4", "fisheye", "opencv8")
"""The lens models that are tried where another does not fit, by their number of coefficients; the
first that leaves little is named."""

MAX_NAMED_DISTANCE = 1000
"""Largest distance, px, whose value says anything."""


class CameraMisfit(NamedTuple):
    """The distance of points from where a camera puts them, px: the median over points and views.

    Attributes:
        common: with one camera for all views, and a free pose in each.
        single: with a camera of its own in each view.
    """

    common: float
    single: float

    @property
    def is_wrong(self) -> bool:
        """Whether the common camera leaves what another one would not."""
        return self.common > DETECTION_NOISE and self.single < MAX_MISFIT_RATIO * self.common

    @property
    def single_rms(self) -> float:
        """The root mean square distance of Gaussian errors whose median distance is `single`."""
        return self.single / float(np.sqrt(np.log(2.0)))

    def is_answered_by(self, pixel_sigma: float) -> bool:
        """Return whether a fit leaves about as little as a camera of its own in each view.

        Args:
            pixel_sigma: standard deviation of u and of v that the fit leaves within a view, px.
        """
        # The median distance of two Gaussian coordinates is 1.18 of their standard deviations.
        distance = float(np.sqrt(2.0 * np.log(2.0))) * pixel_sigma
        return distance < MAX_RIVAL_RATIO * self.single


class ViewsAlone:
    """Fits of single views with a camera of their own, each made once, when it is first asked for.

    Attributes:
        observations: points and pixels of the views.
    """

    def __init__(self, observations: Observations):
        self.observations = observations
        self._distances: dict[int, float | None] = {}

    def distances(
        self, views: Int[np.ndarray, "asked"], image_size: tuple[int, int]
    ) -> list[float]:
        """Return the median distance of a view's points from where its own camera puts them, px.

        Args:
            views: indices of the views. Those that have too few points for a camera are left out.
            image_size: width and height, px.
        """
        for view in views.tolist():
            if view not in self._distances:
                self._distances[view] = self._fitted(view, image_size)
        distances = (self._distances[view] for view in views.tolist())
        return [distance for distance in distances if distance is not None]

    def _fitted(self, view: int, image_size: tuple[int, int]) -> float | None:
        """Return the distance of one view; None if it has too few points."""
        seen = np.asarray(self.observations.visible)[view]
        points = np.asarray(self.observations.points)[view, seen]
        fit = fit_of_any_lens(points, np.asarray(self.observations.pixels)[view, seen], image_size)
        if fit is None:
            return None
        freedom = 2 * np.count_nonzero(seen)
        # Many parameters leave less than the noise.
        return median_distance(fit) * float(np.sqrt(freedom / (freedom - fit.parameter_count)))


class CameraDoubt(NamedTuple):
    """A doubt about the camera that is common to all views.

    Attributes:
        text: what is wrong, in a sentence.
        misfit: how well the camera fits.
    """

    text: str
    misfit: CameraMisfit


def camera_misfit(
    alone: ViewsAlone,
    used: Bool[np.ndarray, "views"],
    camera: Camera,
    camera_from_world: SE3,
) -> CameraMisfit | None:
    """Return how well one camera fits the views; None if it fits well or nothing tells.

    Args:
        alone: the views, as they are fitted alone.
        used: mask of the views to check.
        camera: common to all views.
        camera_from_world: the pose of each view that fits best with this camera.
    """
    common = _usual_distance(alone.observations, used, camera, camera_from_world)
    if not common > DETECTION_NOISE:
        return None
    views = np.flatnonzero(used)
    views = views[evenly_spaced(len(views), MAX_ASKED_VIEWS)]
    distances = alone.distances(views, camera.image_size)
    if not distances:
        return None
    misfit = CameraMisfit(common, float(np.median(distances)))
    return misfit if misfit.is_wrong else None


def camera_problem(
    misfit: CameraMisfit,
    lens: str | AbstractLens,
    is_known: bool,
    fit_with: Callable[[str], tuple[Camera, SE3]],
    observations: Observations,
    used: Bool[np.ndarray, "views"],
) -> str:
    """Return what is wrong with the camera, and which lens would fit, in a sentence.

    Args:
        misfit: of the camera.
        lens: the lens that was fitted, or its name.
        is_known: whether the camera was given and not fitted.
        fit_with: function from a lens's name to the common camera with it, and the poses.
        observations: points and pixels.
        used: as for `camera_misfit`.
    """
    misfits = f"with a free pose in every view it leaves {_in_pixels(misfit.common)} in the median"
    alone = f"a camera of its own in each view leaves {_in_pixels(misfit.single)}"
    if is_known:
        return (
            f"the known camera does not fit these pictures: {misfits}, where {alone}. Is it of "
            "this camera, at this zoom and focus, and are the pictures as it took them, not "
            "undistorted or scaled? Leave out camera= (--camera) to have it found"
        )
    name = lens if isinstance(lens, str) else lens_name(lens)
    best, nearest = name, misfit.common
    for other in TRIED_LENSES:
        # A lens that leaves about as little as a camera in each view cannot be surpassed.
        if other == name or nearest < MAX_RIVAL_RATIO * misfit.single:
            continue
        distance = _usual_distance(observations, used, *fit_with(other))
        best, nearest = min((best, nearest), (other, distance), key=lambda entry: entry[1])
    if nearest < MAX_MISFIT_RATIO * misfit.common:
        return (
            f"the lens {name} does not fit these pictures: {misfits}, where {best} leaves "
            f"{_in_pixels(nearest)}: use lens='{best}' (--lens {best})"
        )
    return (
        f"no single camera fits these pictures: with the lens {name} and a free pose in every view "
        f"it leaves {_in_pixels(misfit.common)} in the median, with {best} "
        f"{_in_pixels(nearest)}, where {alone}. Did zoom or focus change between the "
        "pictures, were some cropped, scaled or undistorted, or is the target stretched along an "
        "axis?"
    )


def _in_pixels(distance: float) -> str:
    """Return a distance in words; it means nothing where points cannot be projected."""
    if distance > MAX_NAMED_DISTANCE:
        return f"over {MAX_NAMED_DISTANCE} px"
    return f"{distance:.2g} px"


def _usual_distance(
    observations: Observations,
    used: Bool[np.ndarray, "views"],
    camera: Camera,
    camera_from_world: SE3,
) -> float:
    """Return the distance of the points from where a camera puts them, px; see `CameraMisfit`."""
    residuals = camera_residuals(camera, host_matrices(camera_from_world), observations)
    distances = np.linalg.norm(residuals, axis=2)
    return float(np.median(medians_by_view(distances, np.asarray(observations.visible))[used]))
