"""A cell that goes where it is told and takes given pictures, and what may be found in them."""

import numpy as np

import smartview_jax as sv
from smartview_jax.cameras import Pinhole
from smartview_jax.geometry import host_transforms
from smartview_jax.localization import (
    Localization,
    Localizations,
    NextView,
    RefinedPose,
    Verdict,
)
from smartview_jax.robots import Command

CAMERA = sv.Camera(300.0, 300.0, 160.0, 120.0, Pinhole(), (320, 240))
CALIBRATION = sv.Calibration.eye_in_hand(CAMERA, np.eye(4), np.eye(4))
"""Base and world are one frame, and so are tool and camera."""

REGION = sv.picking.Region(np.array([0.1, -0.1, 0.0]), (0.24, 0.18, 0.08))

STRIPED = np.kron(np.array([[60, 180] * 4] * 6, np.uint8), np.ones((40, 40), np.uint8))
BLANK = np.full((240, 320), 90, np.uint8)


class FakeCell:
    """A cell without joints, whose pictures are given; an exception among them is raised."""

    def __init__(self, *pictures):
        self.pictures, self.moves = list(pictures), []
        self.unreachable, self.width = (), 0.04

    def move(self, target):
        if len(self.moves) in self.unreachable:
            self.moves.append(None)
            raise sv.simulation.CellError("it does not get there")
        self.moves.append(target)
        return target

    def picture(self):
        picture = self.pictures.pop(0) if self.pictures else STRIPED
        if isinstance(picture, Exception):
            raise picture
        return picture

    def set_gripper(self, width):
        return max(width, self.width)

    def where(self):
        return Command(host_transforms(np.eye(4)))


def seen(model, decision="accepted", *reasons):
    """A model as it was found at its own place, by a verdict without numbers."""
    unused = dict.fromkeys(RefinedPose._fields[6:])
    refined = RefinedPose(np.eye(4), *[np.eye(6)] * 3, np.zeros((6, 0)), (), **unused)
    return Localization(model, 0, refined, Verdict(decision, reasons, None, -20.0, np.inf), ())


def localizations(*results, pictures=(), command=None):
    """What was found, with messages as `localize` has them."""
    at = Command(host_transforms(np.eye(4)[None])) if command is None else command
    messages = [
        localization.message.replace("rejected", "not found")
        for localization in results
        if not localization.accepted
    ]
    return Localizations(results, tuple(messages), pictures, at)


def view_of(reason="it separates the object from 1 remaining rival"):
    """A view to take next."""
    return NextView(np.eye(4), np.eye(4), None, 1.0, (2e-3, 1e-3), 1.0, reason, None)
