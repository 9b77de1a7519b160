"""The package's sample as a camera on a robot that stands at one of its views."""

import shutil
import threading
import time

import numpy as np
from detected_sample import detected_sample

from smartview_jax.capture import (
    CaptureOptions,
    CaptureSession,
    Estimate,
    MotionLimits,
    MoveRefusedError,
    Proposal,
    Reopened,
    SourceLostError,
)
from smartview_jax.detection import read_picture
from smartview_jax.geometry import host_matrices
from smartview_jax.io import GrowingDataset, sample_folder

PATIENCE = 60.0
"""Longest time to wait for a thread, s."""


def new_folder(path):
    """A data set like the sample's, without any view."""
    (path / "images").mkdir(parents=True)
    shutil.copy(sample_folder() / "dataset.yaml", path)
    header = (sample_folder() / "poses.csv").read_text().splitlines()[0]
    (path / "poses.csv").write_text(header + "\n")
    return path


class Rig:
    """A camera and a robot that stand where a view of the sample was taken."""

    def __init__(self):
        self.at = 0
        self.camera_error = self.robot_error = None
        self.opened = {"camera": 0, "robot": 0}
        self.moved_to = []
        self.unreachable = set()
        self.poses = host_matrices(detected_sample().base_from_tool)
        self.sways = False
        # Set while a motion goes on, which `finish` ends.
        self.on_the_way = threading.Event()
        self.finish = threading.Event()
        self.finish.set()

    def picture(self):
        """Views of the sample are numbered as their files."""
        name = detected_sample().view_ids[self.at]
        picture = read_picture(sample_folder() / "images" / f"{name}.png")
        self.shift = 1 - getattr(self, "shift", 0) if self.sways else 0
        return np.roll(picture, self.shift, axis=1)

    def sources(self):
        return (
            Reopened(lambda: self.opened_source("camera", RigCamera), retry_seconds=0.01),
            Reopened(lambda: self.opened_source("robot", RigRobot), retry_seconds=0.01),
        )

    def opened_source(self, kind, source):
        if getattr(self, f"{kind}_error"):
            raise SourceLostError(getattr(self, f"{kind}_error"))
        self.opened[kind] += 1
        return source(self)

    def session(self, folder, **options):
        return CaptureSession(GrowingDataset(folder), *self.sources(), CaptureOptions(**options))


class RigCamera:
    is_continuous = True

    def __init__(self, rig):
        self.rig = rig

    def read(self):
        if self.rig.camera_error:
            raise SourceLostError(self.rig.camera_error)
        return self.rig.picture()

    def close(self):
        pass


class RigRobot:
    def __init__(self, rig):
        self.rig = rig

    def pose(self):
        if self.rig.robot_error:
            raise SourceLostError(self.rig.robot_error)
        return self.rig.poses[self.rig.at].copy()

    def move(self, base_from_tool, speed, stop):
        self.rig.on_the_way.set()
        while not self.rig.finish.wait(0.01):
            if stop.is_set():
                raise MoveRefusedError("stopped")
        distances = np.linalg.norm(self.rig.poses[:, :3, 3] - base_from_tool[:3, 3], axis=1)
        nearest = int(np.argmin(distances))
        if nearest in self.rig.unreachable:
            raise MoveRefusedError("out of reach")
        self.rig.at = nearest
        self.rig.moved_to.append(self.rig.at)

    def close(self):
        pass


def everywhere():
    return MotionLimits((-3.0, -3.0, -3.0), (3.0, 3.0, 3.0))


def quick_fit(rig, goal_at=9):
    """An `estimate` that takes no time: 1 mm over the views, and the sample's own next views."""

    def estimate(data, options, avoided):
        count = data.view_count
        near = [
            np.linalg.norm(rig.poses[:, :3, 3] - pose[:3, 3], axis=1).argmin() for pose in avoided
        ]
        free = [k for k in range(len(rig.poses)) if k not in near]
        proposals = tuple(Proposal(rig.poses[k], False) for k in free[:2])
        errors = [1e-3 * goal_at / (count + k) for k in range(3)]
        return Estimate(count, errors[0], 0.5, None, (), proposals, tuple(errors[1:]))

    return estimate


def wait_until(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)
