"""Do the robot's poses and the camera's poses belong together? The usual mistakes, by name.

Robot and camera are bolted together, so whatever the unknown transforms are, both turn by the same
angle between two views, and some hand-eye transform explains both motions. Where that fails, the
mistakes that people make are tried in turn: poses given inverted, millimetres for metres, angles in
the wrong unit or convention, pictures paired with the wrong poses.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Float

from ..calibration import mount_frames, mount_from_holder
from ..compilation import compiled
from ..geometry import rotation_angle
from .closed_form import motion_pairs, park_martin


class ConventionReport(NamedTuple):
    """What the comparison of robot and camera motion says.

    Attributes:
        problems: sentences; each makes the data unusable as given.
        suspicious_views: view index and sentence, for views that fit the others badly.
        angle_mismatch: median difference of the rotation angles, rad.
        length_ratio: camera motion over robot motion; 1 where the data do not contradict it.
        misfit: median rotation and translation left over by the best hand-eye transform, rad, m.
        misfit_inverted: the same with every pose inverted.
    """

    problems: tuple[str, ...]
    suspicious_views: tuple[tuple[int, str], ...]
    angle_mismatch: float
    length_ratio: float
    misfit: tuple[float, float]
    misfit_inverted: tuple[float, float]


ANGLE_TOLERANCE = np.deg2rad(4.0)
"""Rotation angles of robot and camera may differ by this much between two views (median)."""


def check_conventions(
    base_from_tool: SE3,
    camera_from_world: SE3,
    mount: str,
    weights: Float[Array, "views"] | None = None,
) -> ConventionReport:
    """Compare the motion of the robot with that of the camera, view by view.

    Args:
        base_from_tool: as reported, `(views)`.
        camera_from_world: from the pictures alone, `(views)`.
        mount: where the camera is said to be.
        weights: zero leaves a view out.
    """
    weights = jnp.ones(len(base_from_tool.wxyz_xyz)) if weights is None else weights
    in_hand = mount_frames(mount)[0] == "tool"
    given = mount_from_holder(mount, base_from_tool)
    angles, as_given, inverted = (
        np.asarray(x) for x in _compare(given, given.inverse(), camera_from_world, weights)
    )
    ratio = float(as_given[2])
    mismatch = float(np.nanmedian(angles))
    misfit = (float(as_given[0]), float(as_given[1]))
    misfit_inverted = (float(inverted[0]), float(inverted[1]))

    problems = []
    if mismatch > ANGLE_TOLERANCE:
        problems.append(
            f"between two views robot and camera turn by angles that differ by "
            f"{np.rad2deg(mismatch):.1f} degrees (median): the poses' angles are in another unit "
            f"(degrees?) or convention than stated, or the pictures are paired with wrong poses"
        )
    elif _better_inverted(misfit, misfit_inverted):
        problems.append(
            f"the poses fit the pictures when every one is inverted (left over "
            f"{np.rad2deg(misfit_inverted[0]):.2f} instead of {np.rad2deg(misfit[0]):.2f} degrees, "
            f"{1e3 * misfit_inverted[1]:.1f} instead of {1e3 * misfit[1]:.1f} mm): they "
            f"were given as tool_from_base where base_from_tool is expected, or the camera is "
            f"{'beside the arm (eye_to_hand)' if in_hand else 'on the hand (eye_in_hand)'}"
        )
    elif not 0.2 < ratio < 5.0 and np.isfinite(ratio):
        problems.append(_length_problem(ratio))
    else:
        problems += _implausible(base_from_tool, camera_from_world, np.asarray(weights) > 0.0)
    return ConventionReport(
        tuple(problems), _suspicious(angles), mismatch, ratio, misfit, misfit_inverted
    )


_SLACK = math.radians(0.5)
"""By how much rotations may fit worse where translations fit far better, rad."""


def _better_inverted(given: tuple[float, float], inverted: tuple[float, float]) -> bool:
    """By rotation, or, where all turns are about nearly one axis, by translation."""
    by_rotation = given[0] > ANGLE_TOLERANCE and inverted[0] < 0.3 * given[0]
    by_translation = inverted[1] < 0.1 * given[1] and inverted[0] < given[0] + _SLACK
    return by_rotation or by_translation


REACH = 30.0
"""Metres that no arm reaches and no target is away from its camera."""


def _implausible(base_from_tool: SE3, camera_from_world: SE3, used: np.ndarray) -> list[str]:
    """Lengths that only another unit explains, where the motion itself does not tell."""
    found = []
    for poses, what in (
        (base_from_tool, "the tool is reported {:.0f} m from the base"),
        (camera_from_world, "the target seems to be {:.0f} m from the camera"),
    ):
        places = np.asarray(poses.wxyz_xyz)[used, 4:]
        distance = float(np.median(np.linalg.norm(places, axis=1)))
        if distance > REACH:
            found.append(f"{what.format(distance)}: millimetres where metres are expected?")
    return found


def _length_problem(ratio: float) -> str:
    units = {
        -3: "the robot's positions look like millimetres where metres are expected",
        -2: "the robot's positions look like centimetres where metres are expected",
        2: "the target's points look like centimetres where metres are expected",
        3: "the target's points look like millimetres where metres are expected",
    }
    power = round(float(np.log10(abs(ratio)))) if ratio else 0
    text = units.get(power, "robot positions and target points are not in the same unit")
    return f"{text}: the camera moved {ratio:.3g} times as far as the robot"


def _suspicious(angles: np.ndarray) -> tuple[tuple[int, str], ...]:
    """Views whose rotation disagrees with most others, where most agree among themselves."""
    used = np.isfinite(angles).any(axis=1)
    typical = np.zeros(len(angles))
    typical[used] = np.nanmedian(angles[used], axis=1)
    limit = max(6.0 * float(np.median(typical[used])), np.deg2rad(3.0))
    return tuple(
        (
            int(view),
            f"its rotation differs from the robot's by {np.rad2deg(typical[view]):.1f} degrees "
            f"(median over the other views): is this picture paired with the right pose?",
        )
        for view in np.flatnonzero(typical > limit)
    )


@compiled
def _compare(
    given: SE3, inverted: SE3, camera_from_world: SE3, weights: Array
) -> tuple[Float[Array, "views views"], Float[Array, "3"], Float[Array, "3"]]:
    return (
        _angle_differences(given, camera_from_world, weights),
        *jax.vmap(lambda robot: _closure(SE3(robot), camera_from_world, weights))(
            jnp.stack([given.wxyz_xyz, inverted.wxyz_xyz])
        ),
    )


def _angle_differences(mount_from_holder: SE3, camera_from_world: SE3, weights: Array) -> Array:
    def angles(poses):
        R = poses.rotation().as_matrix()
        cosine = 0.5 * (jnp.einsum("iab,jab->ij", R, R) - 1.0)
        return jnp.arccos(jnp.clip(cosine, -1.0, 1.0))

    gap = jnp.abs(angles(mount_from_holder) - angles(camera_from_world))
    unused = jnp.eye(len(gap), dtype=bool) | (jnp.outer(weights, weights) == 0.0)
    return jnp.where(unused, jnp.nan, gap)


def _closure(mount_from_holder: SE3, camera_from_world: SE3, weights: Array) -> Float[Array, "3"]:
    """Rotation and translation left over by the best hand-eye transform (medians), length ratio."""
    A, B, w = motion_pairs(mount_from_holder, camera_from_world, weights)
    hand_eye, _ = park_martin(mount_from_holder, camera_from_world, weights)
    R = hand_eye.rotation()
    expected = R @ B.rotation() @ R.inverse()
    angle = rotation_angle(A.rotation().inverse() @ expected)
    gap = (A @ hand_eye).translation() - (hand_eye @ B).translation()
    left_over = jnp.stack([angle, jnp.linalg.norm(gap, axis=-1)])
    left_over = jnp.nanmedian(jnp.where(w[None] > 0.0, left_over, jnp.nan), axis=1)
    # Along its own axis a screw motion advances equally far in every frame, whatever the hand-eye
    # transform: d_A = s d_B. An orbit about the target has no advance, and then nothing is said.
    d_A, d_B = _advance(A) * w, _advance(B) * w
    together, squares = jnp.sum(d_A * d_B), jnp.stack([jnp.sum(d_A**2), jnp.sum(d_B**2)])
    lengths = jnp.stack([jnp.sum((w[:, None] * m.translation()) ** 2) for m in (A, B)])
    telling = jnp.all(squares > _TELLING**2 * lengths) & (
        together**2 > _CORRELATED * squares[0] * squares[1]
    )
    ratio = jnp.abs(together) / jnp.where(telling, squares[1], 1.0)
    return jnp.append(left_over, jnp.where(telling, ratio, 1.0))


_CORRELATED = 0.9
"""Squared correlation of the advances of robot and camera above which their ratio is believed."""

_TELLING = 0.02
"""Share of the motion that the advance must be; less is noise."""


def _advance(motion: SE3) -> Float[Array, "pairs"]:
    """Translation along the rotation axis; zero for turns too small to have an axis."""
    vector = motion.rotation().log()
    angle = jnp.linalg.norm(vector, axis=-1)
    turning = angle > np.deg2rad(2.0)
    along = jnp.sum(vector * motion.translation(), axis=-1)
    return jnp.where(turning, along / jnp.where(turning, angle, 1.0), 0.0)
