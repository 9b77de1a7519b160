"""Fit one camera to all views without the robot: Step 1, Step 2, and what makes them repeat.

Step 1 (`weng.py`, Eq. 8) calibrates each view by itself, Step 2 (`kalman.py`, Eq. 9) fits one
camera to all. Both run again without views that show another target, and for a stretched one.
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool

from ..cameras import AbstractLens, Camera, initial_lens, lens_name
from ..data_checks import (
    TRIED_LENSES,
    CameraDoubt,
    CameraMisfit,
    ViewsAlone,
    camera_misfit,
    find_border_misfit,
    find_flexible_target,
    mask_unusable_views,
    minimum_points,
    mismatched_views,
    require_minimum_views,
    unusable_views,
)
from ..dataset import Dataset, Observations
from .picture_steps import Step1, common_camera_doubt, run_step1
from .staged_fit import CommonCameraFit, CommonCameraOptions
from .stretched_target import StretchedTarget, fit_of_stretched_target

MAX_UNCHECKED_POINTS = 6
"""The number of points up to which a view does not say which of them lies apart.

A pose passes through any three points exactly, so that good points look like outliers, or outliers
like good points, where these are half of all.
"""

UNCHECKED_GATE_PROBABILITY = 1.0 - 1e-14
"""The least probability of the outlier gate where most views have so few points: eight standard
deviations, which are understated there, since the poses of the views follow the noise."""


class CameraSteps(NamedTuple):
    """The lens, the camera and the options with which Steps 1 and 2 are run.

    Attributes:
        lens: a name or a lens.
        camera: a known camera; None to estimate it.
        step2: the filter, or a function with the same arguments.
        options: the options of Step 2.
        progress: called with a sentence about each step.
    """

    lens: str | AbstractLens
    camera: Camera | None
    step2: Callable[..., CommonCameraFit]
    options: CommonCameraOptions
    progress: Callable[[str], None] | None

    def say(self, text: str) -> None:
        """Report a sentence about a step."""
        if self.progress is not None:
            self.progress(text)

    def views_alone(self, data: Dataset, observations: Observations, used: np.ndarray) -> Step1:
        """Run Step 1."""
        return run_step1(observations, data.image_size, used, self.lens, self.camera)

    def common(
        self,
        observations: Observations,
        start: Camera,
        camera_from_world: SE3,
        inliers: Bool[Array, "views points"],
    ) -> CommonCameraFit:
        """Run Step 2 from a camera and the poses of the views."""
        return self.step2(
            observations, start, camera_from_world, inliers, self.options, self.progress
        )


class PictureFit(NamedTuple):
    """The answers of Steps 1 and 2, which need no robot.

    Attributes:
        steps: how they were run.
        alone: the usable views as they are fitted alone; of a stretched target, its own points.
        used: mask of the views that were used.
        unusable: views that cannot be used, with the reason, also the mismatched ones.
        mismatched: views that do not show the target, with the reason.
        step1, common: the answers of Steps 1 and 2.
        start_inliers: mask of the points from which Step 2 starts.
        stretched: the fit of a stretched target; None for a target as stated.
    """

    steps: CameraSteps
    alone: ViewsAlone
    used: Bool[np.ndarray, "views"]
    unusable: dict[int, str]
    mismatched: dict[int, str]
    step1: Step1
    common: CommonCameraFit
    start_inliers: Bool[Array, "views points"]
    stretched: StretchedTarget | None

    def step2_from(self, camera: Camera, camera_from_world: SE3) -> CommonCameraFit:
        """Run Step 2 again from another camera or other poses of the views."""
        return self.steps.common(self.observations, camera, camera_from_world, self.start_inliers)

    def misfit(self, used: Bool[np.ndarray, "views"]) -> CameraMisfit | None:
        """Return how badly one camera fits some views; None if it fits, or nothing tells."""
        common = self.common
        return camera_misfit(self.alone, used, common.camera, common.camera_from_world)

    @property
    def observations(self) -> Observations:
        """Points and pixels of the usable views; of a stretched target, its own points."""
        return self.alone.observations

    def doubts(
        self, used: Bool[np.ndarray, "views"], misfit: CameraMisfit | None
    ) -> tuple[CameraDoubt | None, tuple[str, ...]]:
        """Return what is wrong with the camera or the target in some views, if anything, in words.

        The first is what is wrong with one camera for all views. Where nothing is, the sentence
        tells of a target that bends; a stretched target has its own doubt.

        Args:
            used: mask of the views.
            misfit: of the camera in these views.
        """
        if misfit is not None:
            doubt = common_camera_doubt(
                misfit,
                self.observations,
                used,
                self.steps.lens,
                self.steps.camera is not None,
                self._with_lens,
            )
            return doubt, (doubt.text,)
        border = self._border_doubt(used)
        if border:
            return None, (border,)
        if self.stretched is not None:
            return None, ()
        bending = find_flexible_target(
            self.observations,
            np.asarray(self.common.inliers) & used[:, None],
            self.common.camera,
            self.common.camera_from_world,
        )
        return None, () if bending is None else (bending.sentence,)

    def _with_lens(self, name: str) -> CommonCameraFit:
        """Run Step 2 again with another lens."""
        lens = initial_lens(name, self.step1.camera.lens)
        return self.step2_from(
            dataclasses.replace(self.step1.camera, lens=lens), self.step1.camera_from_world
        )

    def _border_doubt(self, used: Bool[np.ndarray, "views"]) -> str:
        """Return that the lens does not fit the border, and which one does; or nothing."""
        common, steps = self.common, self.steps
        inliers = np.asarray(common.inliers)
        misfit = find_border_misfit(
            self.observations, used, inliers, common.camera, common.camera_from_world
        )
        if misfit is None:
            return ""
        if steps.camera is not None:
            return misfit.sentence("the known camera", None)
        name = steps.lens if isinstance(steps.lens, str) else lens_name(steps.lens)
        kept = {
            other: int(np.count_nonzero(np.asarray(self._with_lens(other).inliers)[used]))
            for other in TRIED_LENSES
            if other != name
        }
        best = max(kept, key=lambda other: kept[other])
        gain = kept[best] - int(np.count_nonzero(inliers[used]))
        return misfit.sentence(f"the lens {name}", best if 2 * gain > misfit.left_out else None)


def fit_pictures(data: Dataset, steps: CameraSteps) -> PictureFit:
    """Return the camera that fits all usable views, by Steps 1 and 2.

    Raises:
        ValueError: too few views show the target.
    """
    fewest_points = minimum_points(steps.camera)
    unusable = unusable_views(data, fewest_points)
    steps.say(f"Step 1: each of {data.view_count - len(unusable)} views by itself")
    observations, used = mask_unusable_views(data, unusable)
    step1 = steps.views_alone(data, observations, used)
    # Views that Step 1 could not fit to the target (wrong corner numbering, another object).
    mismatched = mismatched_views(step1.rms, used, observations, data.image_size)
    if mismatched:
        # Repeat without them: they entered the median intrinsics from which Step 2 starts.
        unusable = {**unusable, **mismatched}
        require_minimum_views(data, unusable, fewest_points)
        observations, used = mask_unusable_views(data, unusable)
        step1 = steps.views_alone(data, observations, used)
    steps, inliers = _with_gate_for_few_points(steps, observations, step1)
    steps.say("Step 2: one camera for all views")
    common = steps.common(observations, step1.camera, step1.camera_from_world, inliers)
    alone, stretched = ViewsAlone(observations), None
    if steps.camera is None:

        def fit_again(of_stretched: Observations) -> tuple[Step1, CommonCameraFit]:
            """Return Steps 1 and 2 for other points of the target."""
            steps.say("Steps 1 and 2 again: is the target stretched?")
            again = steps.views_alone(data, of_stretched, used)
            return again, steps.common(of_stretched, again.camera, again.camera_from_world, inliers)

        stretched = fit_of_stretched_target(alone, used, common, fit_again)
    if stretched is not None:
        alone, step1, common = stretched[:3]
    return PictureFit(steps, alone, used, unusable, mismatched, step1, common, inliers, stretched)


def _with_gate_for_few_points(
    steps: CameraSteps, observations: Observations, step1: Step1
) -> tuple[CameraSteps, Bool[Array, "views points"]]:
    """Return the steps and the points to start from, with no outliers where most views are small.

    A small view has at most `MAX_UNCHECKED_POINTS` points.
    """
    counts = np.asarray(observations.visible).sum(axis=1)
    if 2 * np.sum(counts[counts <= MAX_UNCHECKED_POINTS]) <= counts.sum():
        return steps, step1.inliers
    probability = max(steps.options.gate_probability, UNCHECKED_GATE_PROBABILITY)
    options = dataclasses.replace(steps.options, gate_probability=probability)
    return steps._replace(options=options), observations.visible
