"""Look for objects: two views, then further chosen ones until the verdict is clear."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxlie import SE3
from jaxtyping import Float, UInt8

from ..cameras import Camera
from ..engine import Noise
from ..features import PictureEvidence, picture_evidence
from ..geometry import host_transforms, look_at, viewing_direction
from ..grasping import GraspScene
from ..joint import JointFit, RigEstimate, RigFit, SavedEstimate
from ..localization import Localization, Localizations, NextView, Reachable, localize, next_view
from ..modeling import ObjectModel, command_at
from ..robots import BOX_CORNERS, Command, SerialArm
from ..runtime.array_namespace import to_device
from ..simulation import Cell, CellError
from ..viewpoints import viewpoint_commands
from .calibrating import stacked_commands

FIRST_VIEWS = 2
"""Number of initial views; from a single view the scale is uncertain."""

VIEW_COST = 0.1
"""Expected gain of a further view, nats, below which it is not taken, by default.

It shrinks all six standard deviations of a pose by 1.7 %. A third view as good as each of the first
two shrinks them by 18 %, a gain of 1.2 nats, so that this view is worth a twelfth of such a view.
"""


class FirstViews(NamedTuple):
    """The directions and the distance of the first views of a region.

    Attributes:
        distance: of the camera from the middle of the region, m; also of chosen views from their
            object.
        tilt: of the directions from the vertical, rad.
        azimuths: of the directions about the vertical, rad, in order of preference; the first two
            that the robot reaches are taken. By default each is 1.7 rad from the previous one, so
            that any two see the region from different sides.
    """

    distance: float = 0.45
    tilt: float = float(np.deg2rad(22.0))
    azimuths: tuple[float, ...] = (0.6, 2.3, 4.0, 5.7)


class LookOptions(NamedTuple):
    """The number of views of a region, and their places.

    Attributes:
        first: distance and directions of the first views; by default for a camera of 1280 x 800 px
            with a lens of 50 degrees.
        max_views: largest number of views; two are always taken.
        verify: whether objects accepted from two views are verified from a third.
        view_cost: expected gain of a view (`NextView.gain`), nats, below which it is not taken.
    """

    first: FirstViews = FirstViews()
    max_views: int = 4
    verify: bool = True
    view_cost: float = VIEW_COST


DEFAULT_OPTIONS = LookOptions()


class Region(NamedTuple):
    """A box in the world in which objects are searched; objects outside are not found.

    Attributes:
        centre: of its floor, m.
        size: along x, y and z, m.
    """

    centre: Float[np.ndarray, "3"]
    size: tuple[float, float, float]

    @property
    def corners(self) -> Float[np.ndarray, "8 3"]:
        """The corners of the box, m."""
        return self.centre + (BOX_CORNERS + np.array([0.0, 0.0, 0.5])) * np.array(self.size)


class BadPictureError(ValueError):
    """The error that one of the first pictures is unusable; its text names the view."""


class Look(NamedTuple):
    """The pictures that were taken, and the objects found in them.

    Attributes:
        found: in all views together.
        pictures: of all views in their order.
        commands: reported poses of the robot in these views.
        verification: the last view, if it was chosen to verify or to decide an open verdict; None
            if the first two were enough.
        notes: what happened, in words.
    """

    found: Localizations
    pictures: tuple[UInt8[np.ndarray, "rows columns"], ...]
    commands: Command
    verification: NextView | None
    notes: tuple[str, ...]


def look_for(
    cell: Cell,
    scene: GraspScene,
    models: Sequence[ObjectModel],
    region: Region,
    *,
    options: LookOptions = DEFAULT_OPTIONS,
    noise: Noise | None = None,
    progress: Callable[[str], None] | None = None,
) -> Look:
    """Look for objects in a region, from two views and then from chosen ones.

    An object accepted from two views is verified from a third. Further views are taken while the
    verdict on an object is open, each where it is most informative about the open objects. A view
    that is expected to bring less than it costs is not taken.

    Args:
        scene: the calibrated robot, and the obstacles that may hide objects.
        region: where they may be.
        options: how many views are taken, and from where.
        noise: of the robot in these views; by default the noise of the scene's estimate.
        progress: called with a line of text for each step.

    Returns:
        The result for all views. A later view that cannot be taken, or whose picture is unusable,
        is left out, with a note.

    Raises:
        CellError: the robot reaches fewer than two of the first views; the message says why.
        BadPictureError: one of the first two pictures is not taken or is unusable, such as a blank
            one; the message names the view, from 1.
        TypeError: the scene's estimate is of a rig.
        ValueError: as in `localize`, for invalid models, estimate or noise.
    """
    estimate = scene.estimate
    if isinstance(estimate, RigFit | RigEstimate):
        raise TypeError(
            "scene.estimate: expected the estimate of the camera that takes the pictures, such as "
            f"rig_fit.estimate('left'), found {type(estimate).__name__}"
        )
    say = progress or (lambda _: None)
    workspace = np.stack([region.corners.min(axis=0), region.corners.max(axis=0)])
    # As in `localize`: these views are taken by the calibrated robot.
    if noise is None and isinstance(estimate, JointFit | SavedEstimate):
        noise = estimate.noise
    search = partial(
        localize,
        calibration=scene.calibration,
        models=models,
        covariance=estimate,
        noise=noise,
        workspace=workspace,
        occluders=scene.triangles,
    )
    views = _first_views(cell, scene, region, options.first, say)
    say("localising")
    taken = stacked_commands([view.command for view in views])
    results = search([view.evidence for view in views], taken)
    verification, notes = None, []
    while len(views) < options.max_views:
        looked_at = _undecided(results, options.verify and len(views) == FIRST_VIEWS)
        if not looked_at:
            break
        number = len(views) + 1
        try:
            chosen = _chosen_view(
                cell, scene, models, options.first.distance, noise, results, looked_at
            )
            if chosen.gain < options.view_cost:
                notes.append(
                    f"no further view: view {number} would gain {chosen.gain:.2g} nats and costs "
                    f"{options.view_cost:.2g}: {chosen.reason}"
                )
                break
            say(
                f"{'verifying' if looked_at[0].accepted else 'deciding'}: view {number}: "
                f"{chosen.reason}"
            )
            view = _seen(cell, cell.move(_view_command(chosen)), scene.calibration.camera)
            # Judged again, from all views together.
            latest = stacked_commands([view.command])
            results = search([view.evidence], latest, previous=results)
        except (CellError, ValueError) as error:
            # A failed later view does not discard the results of the earlier ones.
            notes.append(f"no further view: view {number}: {error}")
            break
        notes.append(f"view {number}: {chosen.reason}")
        views.append(view)
        verification = chosen
    pictures = tuple(view.picture for view in views)
    commands = stacked_commands([view.command for view in views])
    return Look(results, pictures, commands, verification, tuple(notes))


class _View(NamedTuple):
    """A picture that was taken, its features, and the reported pose of the robot."""

    picture: UInt8[np.ndarray, "rows columns"]
    evidence: PictureEvidence
    command: Command


def _first_views(
    cell: Cell,
    scene: GraspScene,
    region: Region,
    first: FirstViews,
    say: Callable[[str], None],
) -> list[_View]:
    # Aimed above the floor, where objects are.
    middle = region.centre + np.array([0.0, 0.0, 0.25 * region.size[2]])
    views, reasons = [], []
    for azimuth in first.azimuths:
        # Counted by views taken: a view that is not reached has no number.
        number = len(views) + 1
        if number > FIRST_VIEWS:
            break
        say(f"looking: view {number}")
        direction = np.asarray(viewing_direction(first.tilt, azimuth))
        view = look_at(middle, direction[None], first.distance)
        try:
            command = cell.move(_command(cell, scene, view))
        except CellError as error:
            # If a bin's wall or a joint's limit blocks one side, the other sides remain.
            reasons.append(f"azimuth {azimuth:.2g} rad: {error}")
            continue
        try:
            views.append(_seen(cell, command, scene.calibration.camera))
        except (CellError, ValueError) as error:
            # With fewer views the scale would be unknown, so nothing could be found.
            raise BadPictureError(f"view {number}: {error}") from error
    if len(views) < FIRST_VIEWS:
        raise CellError(
            f"first: {len(views)} of {len(first.azimuths)} views are reached; expected "
            f"{FIRST_VIEWS}: {'; '.join(reasons)}"
        )
    return views


def _seen(cell: Cell, command: Command, camera: Camera) -> _View:
    """Take a picture from where the robot stands.

    Raises:
        CellError: no picture is taken.
        ValueError: the picture is unusable.
    """
    picture = cell.picture()
    return _View(picture, picture_evidence(picture, camera), command)


def _chosen_view(
    cell: Cell,
    scene: GraspScene,
    models: Sequence[ObjectModel],
    distance: float,
    noise: Noise | None,
    results: Localizations,
    looked_at: Sequence[Localization],
) -> NextView:
    """Return the most informative further view of objects, from a distance (m), within reach."""
    # Near the current joints, so that the arm stays on its branch.
    near = _start_joints(cell, scene.arm)
    return next_view(
        looked_at,
        scene.calibration,
        Reachable(distance=distance, arm=scene.arm, near=near),
        noise=noise,
        models=models,
        neighbours=results,
        occluders=scene.triangles,
    )


def _undecided(results: Localizations, unverified: bool) -> Sequence[Localization]:
    """Return the objects that need a further view; none if everything is decided."""
    # One view verifies an accepted object; an open one may need several.
    return results.accepted[:1] if results.accepted and unverified else results.open


def _start_joints(cell: Cell, arm: SerialArm | None) -> np.ndarray | None:
    """Return the arm's current joint readings; None without an arm."""
    joints = cell.where().joints
    return None if arm is None or joints is None else np.asarray(joints)


def _view_command(view: NextView) -> Command:
    """Return the command of a chosen view."""
    # The joints were solved with the view: the arm stays on the same branch.
    joints = None if view.joints is None else to_device(np.asarray(view.joints))
    return Command(host_transforms(np.asarray(view.base_from_tool)), joints)


def _command(cell: Cell, scene: GraspScene, view: SE3) -> Command:
    """Return the command for one view, a batch of one; a CellError if the arm does not reach it."""
    near = _start_joints(cell, scene.arm)
    arm = None if near is None else scene.arm
    commands = viewpoint_commands(scene.calibration, view, arm=arm, near=near)
    problem = commands.checks.reasons(("reach", "tool_distance"))[0]
    if problem:
        raise CellError(problem)
    return command_at(commands.command, 0)
