"""Define the input of grasping: an object's model, its pose, and the uncertainty of the pose."""

from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ..geometry import check_rigid
from ..modeling import ObjectModel


@runtime_checkable
class LocalizedObject(Protocol):
    """An object whose pose is known; a `Localization` is one.

    Attributes:
        world_from_object: its pose, 4x4, m.
        covariance: covariance of the pose's tangent, translation first, m^2 and rad^2: `true =
            world_from_object @ exp(xi)`.
        calibration_jacobian: derivatives of xi by numbers of the calibration, `(6, numbers)`; their
            part of the covariance is common to the object and the gripper. None if nothing is
            common or it is unknown.
        calibration_names: names of these numbers, as in the fit of the calibration.
    """

    @property
    def model(self) -> ObjectModel: ...

    @property
    def world_from_object(self) -> np.ndarray: ...

    @property
    def covariance(self) -> np.ndarray: ...

    @property
    def calibration_jacobian(self) -> np.ndarray | None: ...

    @property
    def calibration_names(self) -> tuple[str, ...]: ...


class PlacedObject(NamedTuple):
    """An object whose pose is known from another source, such as a fixture or a drawing.

    Attributes:
        world_from_object: its pose, m.
        covariance: covariance of the pose's tangent, translation first; zero if it is exact.
        calibration_jacobian: as in `LocalizedObject`; None if the pose does not depend on the
            calibration, or it is unknown.
        calibration_names: as in `LocalizedObject`.
    """

    model: ObjectModel
    world_from_object: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"] = np.zeros((6, 6))
    calibration_jacobian: Float[np.ndarray, "6 numbers"] | None = None
    calibration_names: tuple[str, ...] = ()


def checked_object(
    localized: LocalizedObject,
) -> tuple[Float[np.ndarray, "4 4"], Float[np.ndarray, "6 6"]]:
    """Return pose and covariance of an object."""
    name = localized.model.name or "without a name"
    if getattr(localized, "frame", "world") != "world":
        raise ValueError(
            f"object {name}: expected its pose in the world frame of the calibration, found it in "
            'the base frame: localise with RigViews(..., frame="world")'
        )
    pose = np.asarray(localized.world_from_object, dtype=float)
    if pose.shape != (4, 4):
        raise ValueError(f"object {name}: world_from_object has shape {pose.shape}, not (4, 4)")
    # A transposed rotation or millimetres would send the gripper to a wrong place.
    problems = check_rigid(pose[None], (f"object {name}",))
    if problems:
        raise ValueError("; ".join(f"{label}: {text}" for label, text in problems.items()))
    covariance = np.asarray(localized.covariance, dtype=float)
    if covariance.shape != (6, 6) or not np.isfinite(covariance).all():
        raise ValueError(f"object {name}: covariance: expected 6x6 finite numbers")
    # Rounding leaves eigenvalues down to about -1e-16 times the largest.
    eigenvalues = np.linalg.eigvalsh(0.5 * (covariance + covariance.T))
    if not np.allclose(covariance, covariance.T) or eigenvalues[0] < -1e-9 * abs(eigenvalues[-1]):
        raise ValueError(
            f"object {name}: covariance: expected a symmetric matrix without negative "
            f"eigenvalues, found {eigenvalues[0]:.3g}"
        )
    return pose, 0.5 * (covariance + covariance.T)
