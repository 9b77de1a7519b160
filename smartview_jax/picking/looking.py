"""Look for objects: two views, and further chosen ones until the verdict is clear."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ..array_namespace import to_device
from ..calibration import Calibration
from ..engine import Noise
from ..evaluation import CalibrationEstimate
from ..features import PictureEvidence, picture_evidence
from ..geometry import host_transforms, look_at, viewing_direction
from ..grasping import LocalizedObject
from ..localization import Localization, Localizations, NextView, Reachable, localize, next_view
from ..modeling import ObjectModel
from ..robots import BOX_CORNERS, Command, SerialArm
from ..simulation import Cell, CellError
from ..viewpoints import viewpoint_commands
from .calibrating import stacked_commands

TILT, AZIMUTHS = float(np.deg2rad(22.0)), (0.6, 2.3)
"""Tilt of the first views from the vertical, and their directions about it, rad."""

DISTANCE = 0.45
"""Distance of the camera from the middle of the region, m."""


FADE = 60.0
"""Width of the border over which a picture fades around the region, px."""


class Region(NamedTuple):
    """A box of the world in which objects are looked for; what is found elsewhere is left alone.

    Attributes:
        centre: of its floor, m.
        size: along x, y and z, m.
    """

    centre: Float[np.ndarray, "3"]
    size: tuple[float, float, float]

    def contains(self, found: LocalizedObject) -> bool:
        """Return whether the middle of a found object is in the region."""
        pose = np.asarray(found.world_from_object)
        middle = pose[:3, :3] @ found.model.vertices.mean(axis=0) + pose[:3, 3] - self.centre
        half = 0.5 * np.array(self.size[:2])
        return bool((np.abs(middle[:2]) < half).all() and 0.0 < middle[2] < self.size[2])

    @property
    def corners(self) -> Float[np.ndarray, "8 3"]:
        """The corners of the box, m."""
        return self.centre + (BOX_CORNERS + np.array([0.0, 0.0, 0.5])) * np.array(self.size)

    @staticmethod
    def faded(
        picture: UInt8[np.ndarray, "rows columns"], pixels: Float[np.ndarray, "corners 2"]
    ) -> UInt8[np.ndarray, "rows columns"]:
        """Return a picture that fades to its mean outside of the hull of some pixels.

        What lies around a region would be taken for objects, and compete with them. A sharp border
        would be an edge itself. A picture that does not show all corners is left as it is.
        """
        if not np.isfinite(pixels).all():
            return picture
        # Far corners may be far outside, where OpenCV's integers would overflow.
        hull = cv2.convexHull(pixels.clip(-1e4, 1e4).astype(np.float32)).astype(np.int32)
        outside = cv2.fillConvexPoly(np.ones_like(picture), hull, 0)
        distance = cv2.distanceTransform(outside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        weight = np.clip(1.0 - distance / FADE, 0.0, 1.0)
        mean = float(picture.mean())
        return np.rint(mean + weight * (picture - mean)).astype(np.uint8)


class Look(NamedTuple):
    """The pictures that were taken, and what was found in them.

    Attributes:
        found: in all views together.
        inside: the accepted ones in the region, the best first.
        pictures: of all views in their order.
        commands: what the robot reported in these views.
        verification: the view that was chosen to verify, the last one; None if there was none.
        notes: what happened, in words.
    """

    found: Localizations
    inside: tuple[Localization, ...]
    pictures: tuple[UInt8[np.ndarray, "rows columns"], ...]
    commands: Command
    verification: NextView | None
    notes: tuple[str, ...]


def look_for(
    cell: Cell,
    calibration: Calibration,
    models: Sequence[ObjectModel],
    region: Region,
    *,
    arm: SerialArm | None = None,
    estimate: CalibrationEstimate | None = None,
    noise: Noise | None = None,
    max_views: int = 4,
    verify: bool = True,
    progress: Callable[[str], None] | None = None,
) -> Look:
    """Look for objects in a region, from two views and then from chosen ones.

    Args:
        cell: the cell.
        calibration: of its camera and arm.
        models: of the objects that may be there.
        region: where they may be.
        arm: the nominal arm.
        estimate: fit with the calibration's covariance.
        noise: of the robot in these views; by default that of the estimate.
        max_views: largest number of views; two are always taken.
        verify: whether what two views accept is verified from a third one too.
        progress: called with a line of text for each step.

    Raises:
        CellError: the robot does not get to the first views.
        ValueError: a picture in which nothing can be found, such as a blank one.
    """
    say = progress or (lambda _: None)
    pictures, commands, notes = [], [], []
    # Aimed above the floor, where objects are.
    middle = region.centre + np.array([0.0, 0.0, 0.25 * region.size[2]])
    for azimuth in AZIMUTHS:
        say(f"looking: view {len(pictures) + 1}")
        direction = np.asarray(viewing_direction(TILT, azimuth))
        commands.append(cell.move(_command(cell, calibration, middle, direction, arm)))
        pictures.append(cell.picture())
    options = {"covariance": estimate, "noise": noise}

    def evidence(taken: list[np.ndarray], where: Command) -> list[PictureEvidence]:
        """Return what the pictures show of the region."""
        corners = np.asarray(calibration.project(where, region.corners)[0])
        return [
            picture_evidence(region.faded(picture, pixels), calibration.camera)
            for picture, pixels in zip(taken, corners, strict=True)
        ]

    say("localising")
    first = stacked_commands(commands)
    found = localize(evidence(pictures, first), first, calibration, models, **options)
    verification = None
    # A further view only while it may change the verdict.
    while len(pictures) < max_views:
        accepted = _inside(found.accepted, region)
        open_ones = _inside(found.open, region)
        enough = accepted and (not verify or verification is not None)
        if enough or not (accepted or open_ones):
            break
        reachable = Reachable(distance=DISTANCE, arm=arm, near=_near(cell, arm))
        try:
            # What is accepted is verified first, or else what is open is told apart.
            view = next_view(accepted[:1] or open_ones, calibration, reachable, models=models)
            commands.append(cell.move(_view_command(view)))
        except (CellError, ValueError) as error:
            notes.append(f"no further view: {error}")
            break
        say(f"verifying: view {len(pictures) + 1}: {view.reason}")
        notes.append(f"view {len(pictures) + 1}: {view.reason}")
        verification = view
        pictures.append(cell.picture())
        latest = stacked_commands(commands[-1:])
        # Earlier pictures are kept in what was found before.
        newest = evidence(pictures[-1:], latest)
        found = localize(newest, latest, calibration, models, previous=found, **options)
    inside = tuple(_inside(found.accepted, region))
    return Look(
        found, inside, tuple(pictures), stacked_commands(commands), verification, tuple(notes)
    )


def _inside(found: Sequence[Localization], region: Region) -> list[Localization]:
    """Return what is in the region."""
    return [one for one in found if region.contains(one)]


def _near(cell: Cell, arm: SerialArm | None) -> np.ndarray | None:
    """Return the joints from which an arm sets out."""
    joints = cell.where().joints
    return None if arm is None or joints is None else np.asarray(joints)


def _view_command(view: NextView) -> Command:
    """Return the command of a chosen view."""
    joints = None if view.joints is None else to_device(np.asarray(view.joints))
    return Command(host_transforms(np.asarray(view.base_from_tool)), joints)


def _command(
    cell: Cell,
    calibration: Calibration,
    point: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    arm: SerialArm | None,
) -> Command:
    """Return the command by which the camera looks at a point along a direction."""
    views = look_at(point, direction[None], DISTANCE)
    near = _near(cell, arm)
    commands = viewpoint_commands(calibration, views, arm=None if near is None else arm, near=near)
    problem = commands.checks.reasons(("reach", "tool_distance"))[0]
    if problem:
        raise CellError(f"the first view: {problem}")
    pose = commands.base_from_tool
    joints = None if commands.joints is None else commands.joints[0]
    return Command(type(pose)(pose.wxyz_xyz[0]), joints)
