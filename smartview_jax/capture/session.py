"""Take views one by one: look, test, store; fit in the background; move on request."""

import logging
import threading
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, UInt8

from ..dataset import Dataset
from ..detection import Detection, detect
from ..editor import OwnerLock
from ..geometry import host_matrices, host_transforms
from ..io import GrowingDataset, load_dataset
from .coverage import Coverage, coverage
from .estimation import CaptureOptions, Estimate, Proposal, estimate, first_proposals, is_near
from .motion import refuse_if_stopped
from .settling import SettleTest, settle_test
from .sources import Camera, MoveRefusedError, MovingRobot, Reopened, Robot, SourceLostError
from .typed_robot import TypedRobot

_LOGGER = logging.getLogger(__name__)


class NotTakenError(RuntimeError):
    """The error that a view was not taken; nothing was written."""


class Look(NamedTuple):
    """The present picture and pose.

    Attributes:
        detection: the target in it.
        pose: `base_from_tool` that the robot reports, m; None where it is lost.
        time: when, by `time.monotonic`, s.
    """

    picture: UInt8[np.ndarray, "..."]
    detection: Detection
    pose: Float[np.ndarray, "4 4"] | None
    time: float


class _View(NamedTuple):
    """A view that was taken: its pose and the target's points, px."""

    pose: Float[np.ndarray, "4 4"]
    pixels: Float[np.ndarray, "points 2"]


class CaptureSession:
    """Views that are taken with a camera on a robot; all methods may be called by any thread.

    Attributes:
        options: goal and limits.
        listener: called with a line of text for each thing that happens.
        last_look: the last picture that was looked at; None before the first.
        last_settle_test: the settle test of the last attempt to take a view.
        last_estimate: the last fit; None before the first.
        is_moving: whether the robot moves on request of this session.
    """

    def __init__(
        self,
        folder: GrowingDataset,
        camera: Reopened[Camera],
        robot: Reopened[Robot],
        options: CaptureOptions | None = None,
        say: Callable[[str], None] | None = None,
    ):
        """Read the views that the folder has already.

        Args:
            say: called with a line of text for each thing that happens.

        Raises:
            ValueError: the folder has views that cannot be read.
            BlockingIOError: another process captures into the folder.
        """
        self.folder: GrowingDataset = folder
        self.options: CaptureOptions = options or CaptureOptions()
        self._camera, self._robot = camera, robot
        table = folder.table
        self._lock = OwnerLock(table.with_name(f"{table.name}.lock"), "capture")
        self.listener: Callable[[str], None] = say or (lambda _: None)
        target = folder.description.target
        self._board = target.flat_board
        # One thread at a time uses camera and robot.
        self._using = threading.RLock()
        self._stop_motion = threading.Event()
        # Protects the attributes below.
        self._state = threading.RLock()
        self._views: list[_View] = []
        self._last_picture: np.ndarray | None = None
        self.last_look: Look | None = None
        self.last_settle_test: SettleTest | None = None
        self.last_estimate: Estimate | None = None
        self._proposals: list[Proposal] = []
        # Proposed poses at which no view could be taken, and how many of them the last plan knew.
        self._failed: list[np.ndarray] = []
        self._planned_without = 0
        self._fitted_views = 0
        self.is_moving: bool = False
        self._closing = threading.Event()
        self._wanted = threading.Condition(self._state)
        try:
            if folder.names:
                self._add_known(load_dataset(folder.folder, "mask", progress=self.listener))
        except BaseException:
            self._lock.release()
            raise
        self._fitting = threading.Thread(target=self._fit_until_closed, daemon=True)

    def _add_known(self, data: Dataset) -> None:
        """Take over the views that the folder has already."""
        visible = np.asarray(data.visible)[..., None]
        pixels = np.where(visible, np.asarray(data.pixels), np.nan)
        poses = host_matrices(data.base_from_tool)
        self._views = [_View(pose, view) for pose, view in zip(poses, pixels, strict=True)]

    def __enter__(self) -> "CaptureSession":
        """Begin to fit in the background."""
        self._fitting.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the robot, end the thread that fits, and close camera and robot."""
        self.stop()
        self._closing.set()
        with self._wanted:
            self._wanted.notify_all()
        # A fit cannot be interrupted, and a thread that still computes would abort the process.
        self._fitting.join()
        self._camera.close()
        self._robot.close()
        self._lock.release()

    # The state.

    @property
    def view_count(self) -> int:
        """The number of views taken."""
        with self._state:
            return len(self._views)

    @property
    def is_fitting(self) -> bool:
        """Whether a fit is due: some views are in no fit, or all proposed views failed."""
        with self._state:
            return self._is_fit_wanted()

    @property
    def is_typed(self) -> bool:
        """Whether a person types the robot's poses."""
        # Opening it might wait for a network.
        return isinstance(self._robot.current, TypedRobot)

    @property
    def is_stopped(self) -> bool:
        """Whether motions are refused since a stop."""
        return self._stop_motion.is_set()

    @property
    def is_reached(self) -> bool:
        """Whether the expected error of the last fit is as small as wanted."""
        with self._state:
            return self.last_estimate is not None and self.last_estimate.reaches(self.options.goal)

    @property
    def proposal(self) -> Proposal | None:
        """The view to take next; None if none is known, or the goal is reached."""
        with self._state:
            return self._proposals[0] if self._proposals and not self.is_reached else None

    @property
    def troubles(self) -> tuple[str, ...]:
        """Why camera or robot do not answer, in sentences; empty if both do."""
        named = (("camera", self._camera.trouble), ("robot", self._robot.trouble))
        return tuple(f"{name}: {trouble}" for name, trouble in named if trouble)

    def coverage(self) -> Coverage:
        """Return which parts of the picture and which rotations the views cover."""
        with self._state:
            views = list(self._views)
        return coverage(
            [view.pixels for view in views],
            [view.pose for view in views],
            self.folder.description.image_size,
        )

    # Commands of a person or a program.

    def plan_first(self) -> None:
        """Plan the first views from the rough transforms, if there are any and no fit yet.

        Raises:
            ValueError: a missing transform, or too few views within the limits.
        """
        if self.options.start is None:
            return
        # Where a process was killed, the next one goes on after the views that it took.
        planned = first_proposals(self.folder.description, self.options, self._avoided())
        with self._state:
            if self.last_estimate is None or not self.last_estimate.proposals:
                self._proposals = list(planned)

    def look(self) -> Look:
        """Return a picture, its target and the robot's pose; a SourceLostError means no picture."""
        with self._using:
            picture = self._read()
            try:
                pose = self._pose()
            except SourceLostError:
                pose = None
        look = Look(picture, detect(picture, self._board), pose, time.monotonic())
        with self._state:
            self.last_look = look
        return look

    def take(self) -> str:
        """Take a view if everything stands still, and return its name.

        Raises:
            NotTakenError: the target is not found, something moves, or the picture is an old one.
            SourceLostError: camera or robot do not answer.
            OSError: the folder cannot be written to.
            ValueError: a picture of a wrong size, or a pose in a wrong unit.
        """
        # Held throughout, so that no two views are taken at once; the state stays readable.
        with self._using:
            before = self._pose()
            first = self._read()
            second = self._read() if self._camera.get().is_continuous else first
            after = self._pose()
            detected = detect(second, self._board)
            detected_first = detected if second is first else detect(first, self._board)
            test = settle_test(detected_first, detected, before, after)
            with self._state:
                self.last_look = Look(second, detected, after, time.monotonic())
                self.last_settle_test = test
                last = self._last_picture
            if not test.is_settled:
                raise NotTakenError(test.reason)
            if last is not None and np.array_equal(second, last):
                raise NotTakenError("the camera still shows the picture of the last view")
            name = self.folder.add(second, host_transforms(after))
            robot = self._robot.current
            # The pose of the next view has to be typed again.
            if isinstance(robot, TypedRobot):
                robot.forget()
        with self._state:
            self._last_picture = second
            self._views.append(_View(after, detected.pixels))
            self._drop_near(after[None])
            self._wanted.notify_all()
        self.listener(f"view {name} taken: {int(detected.visible.sum())} points")
        return name

    def is_new_place(self) -> bool:
        """Return whether the robot stands at a place from which no view was taken."""
        with self._using:
            pose = self._pose()
        with self._state:
            return not is_near(pose, _stacked([view.pose for view in self._views]))

    def type_pose(self, text: str) -> None:
        """Take the robot's pose from a text that a person typed.

        Raises:
            ValueError: the text is no pose, or this robot reports its poses itself.
        """
        robot = self._robot.get()
        if not isinstance(robot, TypedRobot):
            raise ValueError("the robot reports its poses itself")
        robot.type(text)

    def move_to(self, proposal: Proposal) -> None:
        """Move the robot to a proposed view.

        Raises:
            MoveRefusedError: motions are off, or the pose is outside of the box or not reached.
            SourceLostError: the robot does not answer.
        """
        limits = self.options.motion
        if limits is None:
            raise MoveRefusedError("motions are off: start with --move")
        limits.require_inside(proposal.base_from_tool)
        with self._using:
            refuse_if_stopped(self._stop_motion)
            robot = self._robot.get()
            if not isinstance(robot, MovingRobot):
                raise MoveRefusedError("this robot is not moved by this program")
            # A straight line between two points of a box stays in it.
            limits.require_inside(self._pose())
            with self._state:
                self.is_moving = True
            try:
                robot.move(proposal.base_from_tool, limits.speed, self._stop_motion)
            except SourceLostError as error:
                self._robot.lose(error)
                raise
            finally:
                with self._state:
                    self.is_moving = False

    def stop(self) -> None:
        """Stop the robot's motion, and refuse all others until `allow_motion`.

        May be called while another thread moves the robot.
        """
        self._stop_motion.set()

    def allow_motion(self) -> None:
        """Allow motions again after a stop, which only a person may do."""
        self._stop_motion.clear()

    def skip(self, proposal: Proposal, failed: bool = False) -> None:
        """Forget a proposed view.

        Args:
            failed: whether it could not be taken. Nothing near it is proposed any more, and if no
                proposal is left, others are planned.
        """
        with self._wanted:
            self._proposals = [p for p in self._proposals if p is not proposal]
            if failed:
                self._failed.append(proposal.base_from_tool)
            self._wanted.notify_all()

    def wait_for_fit(self, timeout: float) -> bool:
        """Wait until no fit is due (`is_fitting`); return False after the timeout, s."""
        with self._wanted:
            return self._wanted.wait_for(lambda: not self._is_fit_wanted(), timeout)

    # Work in the background, and parts of the methods above.

    def _is_fit_wanted(self) -> bool:
        """Return whether there are enough views, and some are in no fit or all proposals failed."""
        if len(self._views) < self.options.first_fit:
            return False
        ran_out = not self._proposals and self._planned_without < len(self._failed)
        return self._fitted_views < len(self._views) or ran_out

    def _fit_until_closed(self) -> None:
        """Fit whenever there are new views."""
        while True:
            with self._wanted:
                self._wanted.wait_for(lambda: self._is_fit_wanted() or self._closing.is_set())
                if self._closing.is_set():
                    return
                count, failed = len(self._views), len(self._failed)
            # Whatever fails in a fit, the next one has more views.
            try:
                self._fit()
            except Exception as error:
                _LOGGER.exception("a fit failed")
                self.listener(f"the fit failed: {error}")
            with self._wanted:
                self._fitted_views, self._planned_without = count, failed
                self._wanted.notify_all()

    def _fit(self) -> None:
        """Fit the views in the folder, and take over the proposals."""
        with self.folder.lock:
            data = load_dataset(self.folder.folder, "mask")
        newest = estimate(data, self.options, self._avoided())
        error = f"{1e3 * newest.error:.2g} mm" if np.isfinite(newest.error) else "not known yet"
        # Said before an automatic run can see it and say that its goal is reached.
        self.listener(f"fit of {newest.views} views: expected error {error}")
        with self._state:
            self.last_estimate = newest
            # A calibration from few views may be far off: until then the drawing is safer.
            if newest.proposals and (newest.is_reliable or not self._proposals):
                self._proposals = list(newest.proposals)
                # Meanwhile more views may have been taken.
                self._drop_near(self._avoided())

    def _avoided(self) -> Float[np.ndarray, "places 4 4"]:
        """Return the poses near which no further view is wanted: of views, and of failures."""
        with self._state:
            return _stacked([*(view.pose for view in self._views), *self._failed])

    def _drop_near(self, places: Float[np.ndarray, "places 4 4"]) -> None:
        """Forget proposals near some places; called while the state is held."""
        self._proposals = [p for p in self._proposals if not is_near(p.base_from_tool, places)]

    def _read(self) -> UInt8[np.ndarray, "..."]:
        """Return a picture; a camera that fails is opened again later."""
        camera = self._camera.get()
        try:
            return camera.read()
        except OSError as error:
            self._camera.lose(error)
            raise SourceLostError(f"camera: {error}") from error

    def _pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the robot's pose; a connection that fails is opened again later."""
        robot = self._robot.get()
        try:
            return robot.pose()
        except OSError as error:
            # A person who has not typed yet is not lost.
            if isinstance(robot, TypedRobot):
                raise SourceLostError(str(error)) from error
            self._robot.lose(error)
            raise SourceLostError(f"robot: {error}") from error


def _stacked(poses: Sequence[Float[np.ndarray, "4 4"]]) -> Float[np.ndarray, "poses 4 4"]:
    """Return poses as one array, also if there are none."""
    return np.reshape(poses, (-1, 4, 4))
