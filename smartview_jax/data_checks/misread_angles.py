"""List the mistakes of angles that were read in another format or unit than they were written in.

They are corrected by converting the rotation back to the numbers of the format that was read, and
reading these numbers in the right one.
"""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from .angle_formats import FANUC, FORMATS, KUKA, UNUSUAL_FORMATS, RotationFormat
from .given_poses import GivenPoses, Mistake, rotation_mistake, turning_alike


def angle_format_mistakes() -> Iterator[Mistake]:
    """Yield the mistakes of angles read in a different format or unit than they were written in."""
    yield rotation_mistake(
        "kuka_abc_for_fanuc_wpr",
        "the angles are kuka_abc (yaw_pitch_roll) and were read as fanuc_wpr, or the reverse "
        "(first and third angle swapped)",
        lambda R: KUKA.to_matrices(FANUC.from_matrices(R)),
    )
    for read_format, true_format in _misread_pairs():
        # Two triples of numbers describe the rotation that was read, and the true format may
        # produce either of them, another one in each view; try both for the first view. With equal
        # outer axes the two differ by the sign of the second angle, which other formats have.
        ambiguous = read_format.second_angle_range is None or (0.0, np.pi) in (
            read_format.second_angle_range,
            true_format.second_angle_range,
        )
        name = f"{true_format.name}_read_as_{read_format.name}"
        description = (
            f"the angles are {true_format.description} and were read as "
            f"{_read_as(read_format, true_format)}"
        )
        # Defaults bind the loop's values now; the functions are called later.
        for prefer_alternative in (False, True) if ambiguous else (False,):
            yield Mistake(
                name,
                description,
                lambda given, read=read_format, true=true_format, alternative=prefer_alternative: (
                    given.with_rotations(given.reread(read, true, alternative))
                ),
            )
        if ambiguous:
            yield Mistake(
                name,
                description,
                lambda given, read=read_format, true=true_format: given.with_rotations(
                    _fitting_rotations(given, read, true)
                ),
            )
    for rotation_format in FORMATS:
        # Radians read as degrees: KUKA's and Fanuc's angles are the same three, in reverse order.
        if rotation_format is not FANUC:
            yield rotation_mistake(
                f"radians_as_degrees_{rotation_format.name}",
                f"the angles ({rotation_format.description}) are in radians and were read as "
                "degrees",
                lambda R, form=rotation_format: form.to_matrices(np.rad2deg(form.from_matrices(R))),
            )


def _misread_pairs() -> Iterator[tuple[RotationFormat, RotationFormat]]:
    """Yield pairs of the format that was read and the true one, each effect once."""
    for read_format, true_format in itertools.permutations(FORMATS, 2):
        if {read_format, true_format} != {KUKA, FANUC}:
            yield read_format, true_format
    # Fanuc's angles are KUKA's in reverse order, and so are the conventions with reversed axes that
    # are fixed instead of moving. What was read as Fanuc's is a pair with KUKA's, therefore; two
    # such pairs are among the ones above.
    for read_format, true_format in itertools.product(FORMATS, UNUSUAL_FORMATS):
        known = read_format is KUKA and true_format.name in ("euler_ZYX_fixed", "euler_ZYZ_fixed")
        if read_format is not FANUC and not known:
            yield read_format, true_format


def _read_as(read_format: RotationFormat, true_format: RotationFormat) -> str:
    """Return as what angles were read, with the equal mistake of Fanuc's angles."""
    if read_format is not KUKA or true_format not in UNUSUAL_FORMATS:
        return read_format.description
    # Reversed axes, fixed instead of moving, are the same angles in reverse order.
    _, axes, kind = true_format.name.split("_")
    reverse = f"euler_{axes[::-1]}_{'fixed' if kind == 'moving' else 'moving'}"
    return f"{read_format.description} (or {reverse} as fanuc_wpr)"


def _fitting_rotations(
    given: GivenPoses, read_format: RotationFormat, true_format: RotationFormat
) -> Float[np.ndarray, "views 3 3"]:
    """Return the rotations by the triples of numbers with which the robot turns as the camera does.

    Of the two rotations that a view may have, the one is chosen whose angles to the other views are
    closer to the camera's.
    """
    candidates = np.stack(
        [given.reread(read_format, true_format, alternative) for alternative in (False, True)]
    )
    return candidates[
        turning_alike(candidates, given.camera[:, :3, :3]), np.arange(len(given.robot))
    ]
