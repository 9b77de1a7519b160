"""Convert rigid transforms to and from the mappings of plain numbers that files contain."""

from typing import Any

import numpy as np
from jaxlie import SE3

from ..runtime.array_namespace import to_device


def transform_to_dict(transform: SE3) -> dict[str, list[float]]:
    """Return the translation (m) and the unit quaternion (real part first) of a transform."""
    numbers = np.asarray(transform.wxyz_xyz).tolist()
    return {"translation": numbers[4:], "quaternion_wxyz": numbers[:4]}


def transform_from_dict(name: str, content: dict[str, Any]) -> SE3:
    """Return the transform that a mapping describes, the inverse of `transform_to_dict`.

    Args:
        name: name of the transform, for messages.
        content: `translation` and `quaternion_wxyz`.

    Raises:
        ValueError: not a rigid transform; the message has the transform's name.
        KeyError: an entry is missing.
    """
    translation = np.asarray(content["translation"], dtype=float)
    quaternion = np.asarray(content["quaternion_wxyz"], dtype=float)
    if translation.shape != (3,) or quaternion.shape != (4,):
        raise ValueError(f"{name}: expected 3 and 4 numbers")
    if not (np.isfinite(translation).all() and abs(np.linalg.norm(quaternion) - 1.0) < 1e-6):
        raise ValueError(f"{name}: not a finite translation and a unit quaternion")
    return SE3(to_device(np.concatenate([quaternion, translation])))
