"""State what grasping has to know of a found object: which one it is, where, and how well known."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ..geometry import check_rigid
from ..modeling import ObjectModel


@runtime_checkable
class LocalizedObject(Protocol):
    """An object whose pose is known; a `Localization` is one.

    Attributes:
        model: of the object.
        world_from_object: its pose, 4x4, m.
        covariance: of the pose's tangent at the object, translation first, m^2 and rad^2:
            `true = world_from_object @ exp(xi)`.
        calibration_jacobian: derivatives of xi by the numbers of the calibration, `(6, numbers)`,
            one for each shared number of `CalibrationUncertainty`; their part of the covariance
            is what the object has in common with the gripper. None if nothing is in common, or
            nothing is known of it.
    """

    @property
    def model(self) -> ObjectModel: ...

    @property
    def world_from_object(self) -> np.ndarray: ...

    @property
    def covariance(self) -> np.ndarray: ...

    @property
    def calibration_jacobian(self) -> np.ndarray | None: ...


class PlacedObject(NamedTuple):
    """An object whose pose is known from elsewhere, such as a fixture or a drawing.

    Attributes:
        model: of the object.
        world_from_object: its pose, m.
        covariance: of the pose's tangent at the object, translation first; zero if it is exact.
        calibration_jacobian: as in `LocalizedObject`; None for a pose that owes nothing to the
            calibration, or of which that is not known.
    """

    model: ObjectModel
    world_from_object: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"] = np.zeros((6, 6))
    calibration_jacobian: Float[np.ndarray, "6 numbers"] | None = None


def checked_object(
    found: LocalizedObject,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]:
    """Return pose and covariance of an object.

    Raises:
        ValueError: the pose is not rigid, or the covariance is not finite, symmetric and positive
            semidefinite; the message names the object.
    """
    name = found.model.name or "without a name"
    pose = np.asarray(found.world_from_object, dtype=float)
    if pose.shape != (4, 4):
        raise ValueError(f"object {name}: world_from_object has shape {pose.shape}, not (4, 4)")
    # A transposed rotation or millimetres would send the gripper somewhere else.
    problems = check_rigid(pose[None], (f"object {name}",))
    if problems:
        raise ValueError("; ".join(f"{label}: {text}" for label, text in problems.items()))
    covariance = np.asarray(found.covariance, dtype=float)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(f"object {name}: covariance: expected 6x6 finite numbers")
    # Rounding leaves eigenvalues of about -1e-16 of the largest.
    eigenvalues = np.linalg.eigvalsh(0.5 * (covariance + covariance.T))
    if not np.allclose(covariance, covariance.T) or eigenvalues[0] < -1e-9 * abs(eigenvalues[-1]):
        raise ValueError(
            f"object {name}: covariance: expected a symmetric matrix without negative "
            f"eigenvalues, found {eigenvalues[0]:.3g}"
        )
    # Exactly symmetric, as what follows takes it to be.
    return pose, 0.5 * (covariance + covariance.T)
