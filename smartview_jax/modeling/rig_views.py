"""Say which camera of a rig took each view, and in which state of the robot."""

from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..argument_checks import require_names, require_one_of
from ..calibration import Calibration
from ..cameras import AnyCamera, ViewCameras
from ..engine import parameter_names
from ..geometry import as_se3, host_matrices
from ..joint import RigEstimate
from ..robots import SAME_POSE_TOLERANCE

if TYPE_CHECKING:
    from ..joint import RigFit

FRAMES = "world", "base"
"""Frames in which results can be given."""

SAME_WORLD = 1e-9
"""Largest difference of `holder_from_world` of cameras that share a world, m and rad."""


class CameraChain(NamedTuple):
    """The views of one camera, and its chain of transforms to the frame of the results.

    Attributes:
        calibration: its calibration, whose world is that frame.
        views: indices of its views.
        is_fixed: whether the robot's pose does not matter: a camera next to the arm, base frame.
        numbers: the rig's name of each of its parameters, in their order; None for parameters that
            do not matter.
    """

    camera: str
    calibration: Calibration
    views: Int[np.ndarray, "views"]
    is_fixed: bool
    numbers: tuple[str | None, ...]


class RigViews:
    """Views of several cameras: which camera took each, and in which state of the robot.

    Everything that takes a `Calibration` for its views takes this in its place: localisation,
    triangulation, models. The joint covariance of the rig is part of it, so that errors that
    pictures share, of a camera or of the robot in one state, count once.

    Attributes:
        calibrations: calibration of each camera, by its name.
        cameras: name of the camera of each view.
        states: name or number of the robot's state in which each view was taken; None if views of
            different cameras at the same reported pose are one state.
        frame: frame of all results, `"world"` or `"base"`.
        estimate: joint covariance of the rig; None if the calibrations are taken as exact.

    With a pair of cameras on the hand, two pictures that they took at one pose, and a model,
    `sv.localize([left, right], [pose, pose], views, model)` finds the object with:

        >>> pair = {"left": truth, "right": truth}
        >>> views = sv.RigViews(pair, ["left", "right"])
        >>> views
        <RigViews: left, right; world frame, taken as exact>

    With the fit of a rig in the place of `pair`, its joint covariance is part of every result. A
    pair next to the arm needs no robot: `sv.localize([left, right], None, views, model)` with
    `frame="base"`.
    """

    def __init__(
        self,
        rig: "RigFit | RigEstimate | Mapping[str, Calibration]",
        cameras: Sequence[str],
        states: Sequence[Hashable] | None = None,
        frame: str = "world",
    ):
        """Name the camera of each view.

        Args:
            rig: fit of a rig, or its calibrations by name, which are then taken as exact.
            cameras: name of the camera of each view.
            states: name or number of the robot's state in which each view was taken. By default
                views that different cameras took at the same reported pose are one state.
            frame: `"world"`, the target's frame, if all these cameras saw one target; or `"base"`,
                which cameras on the hand and next to the arm have in common. In the base frame a
                camera next to the arm does not need the robot's poses.

        Raises:
            ValueError: an unknown camera or frame, no views, another number of states, a parameter
                that the rig's data do not determine, or cameras without a common world.
        """
        require_names("cameras", cameras)
        self.estimate: RigEstimate | None = None
        if not isinstance(rig, Mapping):
            self.estimate = rig if isinstance(rig, RigEstimate) else RigEstimate.of(rig)
        known = rig if isinstance(rig, Mapping) else rig.calibrations
        self.calibrations: Mapping[str, Calibration] = dict(known)
        self.cameras: tuple[str, ...] = tuple(cameras)
        self.states: tuple[Hashable, ...] | None = None if states is None else tuple(states)
        self.frame = frame
        self._check()

    def __repr__(self) -> str:
        known = "taken as exact" if self.estimate is None else "with their joint covariance"
        return f"<RigViews: {', '.join(self.cameras)}; {self.frame} frame, {known}>"

    def __len__(self) -> int:
        return len(self.cameras)

    def _check(self) -> None:
        """Raise a ValueError for names that are unknown or do not go together."""
        if not self.cameras:
            raise ValueError("cameras: expected the name of the camera of each view, found none")
        for view, name in enumerate(self.cameras):
            if name not in self.calibrations:
                raise ValueError(
                    f"cameras: view {view}: expected a camera of {', '.join(self.calibrations)}, "
                    f"found {name!r}"
                )
        if self.states is not None and len(self.states) != len(self.cameras):
            raise ValueError(
                f"states: expected one for each of {len(self.cameras)} views, found "
                f"{len(self.states)}"
            )
        require_one_of("frame", self.frame, FRAMES)
        if self.frame == "world":
            self._check_common_world()

    def _check_common_world(self) -> None:
        """Raise a ValueError for cameras that saw different targets."""
        first = self.cameras[0]
        a = self.calibrations[first]
        for name in self.names[1:]:
            b = self.calibrations[name]
            difference = host_matrices(a.holder_from_world) - host_matrices(b.holder_from_world)
            if a.mount != b.mount or np.abs(difference).max() > SAME_WORLD:
                raise ValueError(
                    f"cameras: {first!r} and {name!r} saw different targets, so they have no "
                    'common world frame; use frame="base"'
                )

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the cameras that took views, without repetition."""
        return tuple(dict.fromkeys(self.cameras))

    @property
    def camera(self) -> AnyCamera:
        """The intrinsics and lenses of all views."""
        names = self.names
        if len(names) == 1:
            return self.calibrations[names[0]].camera
        index = np.array([names.index(name) for name in self.cameras])
        return ViewCameras.of([self.calibrations[name].camera for name in names], index)

    def chains(self) -> Iterator[CameraChain]:
        """Return each camera's views and chain of transforms."""
        for name in self.names:
            given = self.calibrations[name]
            chain = _in_base(given) if self.frame == "base" else given
            numbers = parameter_names(given)
            if self.estimate is not None:
                numbers = self.estimate.camera_names[name]
            number_of = dict(zip(parameter_names(given), numbers, strict=True))
            # The base frame is not known by the target's pose.
            target = f"{given.transform_names[1]}."
            is_free = self.frame == "base"
            yield CameraChain(
                name,
                chain,
                np.flatnonzero(np.array(self.cameras) == name),
                is_free and given.mount == "eye_to_hand",
                tuple(
                    None if is_free and local.startswith(target) else number_of[local]
                    for local in parameter_names(chain)
                ),
            )

    @property
    def needs_poses(self) -> bool:
        """Whether a view depends on the robot's pose."""
        return not all(chain.is_fixed for chain in self.chains())

    def state_indices(
        self, base_from_tool: Float[np.ndarray, "views 4 4"]
    ) -> Int[np.ndarray, "views"]:
        """Return the index of the robot's state in each view.

        Args:
            base_from_tool: reported pose of each view.

        Raises:
            ValueError: views of one state whose reported poses differ.
        """
        first: list[int] = []
        indices = np.zeros(len(self.cameras), dtype=int)
        for view, pose in enumerate(base_from_tool):
            same = [k for k, v in enumerate(first) if self._are_one_state(indices, k, view)]
            for k in same:
                difference = float(np.abs(base_from_tool[first[k]] - pose).max())
                if difference <= SAME_POSE_TOLERANCE:
                    indices[view] = k
                    break
                if self.states is not None:
                    raise ValueError(
                        f"poses: views {first[k]} and {view} are of one state of the robot, "
                        f"{self.states[view]!r}, but their poses differ by {difference:.2g}"
                    )
            else:
                indices[view] = len(first)
                first.append(view)
        return indices

    def _are_one_state(self, indices: Int[np.ndarray, "views"], state: int, view: int) -> bool:
        """Return whether a view can be of the same state of the robot as earlier views."""
        earlier = np.flatnonzero(indices[:view] == state)
        if self.states is not None:
            return self.states[view] == self.states[earlier[0]]
        # A camera takes one picture in a state; a second one at the same pose is of another.
        return self.cameras[view] not in [self.cameras[k] for k in earlier]

    def of_views(self, views: Sequence[int] | np.ndarray) -> "RigViews":
        """Return some of the views."""
        states = None if self.states is None else [self.states[k] for k in views]
        rig = self.calibrations if self.estimate is None else self.estimate
        return RigViews(rig, [self.cameras[k] for k in views], states, self.frame)

    def followed_by(
        self,
        poses: Float[np.ndarray, "views 4 4"],
        later: "RigViews",
        later_poses: Float[np.ndarray, "later 4 4"],
    ) -> "RigViews":
        """Return these views and later ones of the same rig, which are of other states.

        Args:
            poses: reported pose of each of these views.
            later: the later views.
            later_poses: reported pose of each of the later views.
        """
        states = [("earlier", k) for k in self.state_indices(poses)]
        states += [("later", k) for k in later.state_indices(later_poses)]
        rig = later.calibrations if later.estimate is None else later.estimate
        return RigViews(rig, (*self.cameras, *later.cameras), states, later.frame)


AnyCalibration = Calibration | RigViews
"""The calibration of all views, or the cameras that took them."""


def calibration_of_views(
    calibration: AnyCalibration, views: Sequence[int] | np.ndarray
) -> AnyCalibration:
    """Return the calibration of some of the views."""
    return calibration if isinstance(calibration, Calibration) else calibration.of_views(views)


def _in_base(calibration: Calibration) -> Calibration:
    """Return the calibration with the base frame in the place of its world."""
    calibration.require_one_arm("pictures of several cameras")
    # The chain of a camera next to the arm ends at the base, wherever the robot is.
    is_fixed = calibration.mount == "eye_to_hand"
    return Calibration(
        calibration.camera,
        calibration.camera_from_mount,
        as_se3(np.eye(4)),
        calibration.mount,
        robot_error=None if is_fixed else calibration.robot_error,
    )
