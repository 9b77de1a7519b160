"""Use the result for earlier views of a scene: its poses, its commands, and its calibration."""

import jax
import numpy as np

from ..calibration import Calibration
from ..cameras import Camera
from ..geometry import host_matrices
from ..modeling import AnyCalibration, RigViews, SeenViews, command_at
from ..robots import Command
from .judging import Localizations

SAME_CALIBRATION = 1e-9
"""Largest relative difference of numbers of two calibrations that count as the same.

It is the rounding of a calibration that was saved and loaded again.
"""


def together_with(
    previous: Localizations, calibration: AnyCalibration, command: Command
) -> tuple[AnyCalibration, Command]:
    """Return the calibration and the reported poses of earlier views and later ones together.

    Args:
        previous: result for the earlier views.
        calibration: of the later views, or their cameras.
        command: reported poses of the later views.

    Raises:
        ValueError: the earlier views were read with another calibration.
    """
    earlier = previous.calibration
    joined = joined_commands(previous.command, command)
    if isinstance(calibration, Calibration):
        if isinstance(earlier, Calibration):
            _check_same(earlier, calibration, previous.command, "")
        elif earlier is not None:
            raise ValueError(
                "previous: its views are of several cameras; give RigViews of the same rig, which "
                "name the cameras of the new views"
            )
        return calibration, joined
    if not isinstance(earlier, RigViews):
        raise ValueError(
            "previous: it was found with a single calibration; give that one, or localize the "
            "pictures of all views together with RigViews"
        )
    if earlier.frame != calibration.frame:
        raise ValueError(
            f"previous: its poses are in the {earlier.frame} frame, the new ones in the "
            f"{calibration.frame} frame"
        )
    poses = [host_matrices(part.base_from_tool) for part in (previous.command, command)]
    for chain in earlier.chains():
        now = calibration.calibrations.get(chain.camera)
        if now is None:
            raise ValueError(
                f"previous: its views are of camera {chain.camera!r}, which the rig of the new "
                f"views does not have: {', '.join(calibration.calibrations)}"
            )
        of_camera = command_at(previous.command, chain.views)
        _check_same(earlier.calibrations[chain.camera], now, of_camera, f" of {chain.camera!r}")
    return earlier.followed_by(poses[0], calibration, poses[1]), joined


def _check_same(earlier: Calibration, now: Calibration, command: Command, whose: str) -> None:
    """Raise a ValueError unless earlier views were read with the same calibration.

    Args:
        earlier: calibration with which they were read.
        now: calibration for the same views.
        command: reported poses of the earlier views.
        whose: the camera in words, or empty.
    """
    poses = [SeenViews.of(calibration, command).camera_from_world for calibration in (earlier, now)]
    difference = _camera_difference(earlier.camera, now.camera)
    if not difference and not np.allclose(*poses, rtol=0.0, atol=SAME_CALIBRATION):
        shift = np.linalg.norm(poses[0][:, :3, 3] - poses[1][:, :3, 3], axis=1).max()
        difference = f"camera poses that differ by up to {1e3 * shift:.3g} mm in translation"
    if difference:
        raise ValueError(
            f"previous: its views were read with another calibration{whose}, {difference}; give "
            "the same calibration, or localize the pictures of all views together"
        )


def _camera_difference(earlier: Camera, now: Camera) -> str:
    """Return in words by what a camera differs from an earlier one; empty if they are the same."""
    if earlier.image_size != now.image_size:
        sizes = ["x".join(map(str, camera.image_size)) for camera in (earlier, now)]
        return f"of a camera of {sizes[0]} px, not {sizes[1]} px"
    kinds = [type(camera.lens).__name__ for camera in (earlier, now)]
    if kinds[0] != kinds[1]:
        return f"with a lens of type {kinds[0]}, not {kinds[1]}"
    for (path, a), b in zip(
        jax.tree_util.tree_leaves_with_path(earlier), jax.tree.leaves(now), strict=True
    ):
        if not np.allclose(a, b, rtol=SAME_CALIBRATION, atol=SAME_CALIBRATION):
            name = jax.tree_util.keystr(path).lstrip(".")
            first, second = (", ".join(f"{x:.6g}" for x in np.ravel(leaf)) for leaf in (a, b))
            return f"with {name} {first}, not {second}"
    return ""


def own_command(views: SeenViews) -> Command:
    """Return the reported poses of the views, without padding, on the host."""
    count = len(views.camera_from_world)
    return jax.tree.map(lambda x: np.asarray(x)[:count], views.command)


def joined_commands(first: Command, second: Command) -> Command:
    """Return two batches of commands as one, with joint readings where both have them."""
    if first.joints is None or second.joints is None:
        first, second = Command(first.base_from_tool), Command(second.base_from_tool)
    return jax.tree.map(lambda a, b: np.concatenate([a, b]), first, second)
