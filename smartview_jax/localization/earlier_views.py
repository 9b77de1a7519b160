"""Use the result for earlier views of a scene: its poses, its commands, and its calibration."""

import jax
import numpy as np

from ..calibration import Calibration
from ..cameras import Camera
from ..modeling import SeenViews
from ..robots import Command
from .hypotheses import Hypothesis
from .localization import Localizations

SAME_CALIBRATION = 1e-9
"""Largest relative difference of numbers of two calibrations that count as the same.

It is the rounding of a calibration that was saved and loaded again.
"""


def check_calibration(previous: Localizations, calibration: Calibration) -> None:
    """Raise a ValueError unless earlier views were read with the same calibration.

    All views share one camera, so that another camera would read the earlier pictures wrongly.

    Args:
        previous: result for the earlier views.
        calibration: of all views.
    """
    if previous.calibration is None:
        return
    earlier = SeenViews.of(previous.calibration, previous.command).camera_from_world
    now = SeenViews.of(calibration, previous.command).camera_from_world
    difference = _camera_difference(previous.calibration.camera, calibration.camera)
    if not difference and not np.allclose(earlier, now, rtol=0.0, atol=SAME_CALIBRATION):
        shift = np.linalg.norm(earlier[:, :3, 3] - now[:, :3, 3], axis=1).max()
        difference = f"camera poses that differ by up to {1e3 * shift:.3g} mm in translation"
    if difference:
        raise ValueError(
            f"previous: its views were read with another calibration, {difference}; give the same "
            "calibration, or localize the pictures of all views together"
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


def hypotheses_of(previous: Localizations | None) -> list[Hypothesis]:
    """Return every pose that earlier views left open or accepted, rivals included."""
    kept = [result for result in previous or () if result.verdict.decision != "rejected"]
    poses = [(result.model_index, result.world_from_object) for result in kept]
    poses += [(rival.model, rival.world_from_object) for result in kept for rival in result.rivals]
    return [Hypothesis(model, pose, 0.0, 0.0) for model, pose in poses]
