"""Write a calibration with its covariance to a file, and read both back.

Modelling, localisation and grasping need the covariance of the calibration that they use.
"""

import dataclasses
import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..argument_checks import errors_at
from ..calibration import Calibration
from ..dataset import DepthSensor
from ..engine import Noise, Observability, PoseDirections, parameter_names
from ..files import finite_or_null
from ..schemas.calibration_content import calibration_content

if TYPE_CHECKING:
    from .joint_fit import JointFit


class SavedEstimate(NamedTuple):
    """A calibration from a file, with the covariance of its parameters.

    Attributes:
        calibration: the calibration.
        covariance: covariance of the parameters that were estimated, in their own units.
        parameter_names: names of these parameters.
        noise: standard deviations of pixels and reported poses; None if the robot was trusted.
        pixel_sigma: standard deviation of u and of v, px.
        observability: the rank of the fit; all parameters are determined.
        sensor: the depth sensor whose points were fitted; None for pictures and other trackers.
    """

    calibration: Calibration
    covariance: Float[np.ndarray, "free free"]
    parameter_names: tuple[str, ...]
    noise: Noise | None
    pixel_sigma: float
    observability: Observability
    sensor: DepthSensor | None = None

    @classmethod
    def of(cls, fit: "JointFit") -> "SavedEstimate":
        """Return the part of a fit that its file has."""
        return cls(
            fit.calibration,
            np.asarray(fit.covariance),
            fit.parameter_names,
            fit.noise,
            float(fit.pixel_sigma),
            fit.observability,
            fit.sensor,
        )

    def save(
        self,
        path: str | os.PathLike[str],
        run: str | None = None,
        source: str | None = None,
        warnings: Sequence[str] = (),
        pictures: Sequence[str] = (),
    ) -> None:
        """Write the calibration with its covariance and noise; arguments as of `JointFit.save`."""
        self.calibration.save(
            path,
            run,
            warnings,
            source=source,
            uncertainty=uncertainty_to_dict(self),
            pictures=pictures,
        )


def uncertainty_to_dict(fit: SavedEstimate) -> dict[str, Any] | None:
    """Return the uncertainty of a fit as plain numbers; None if a parameter is undetermined."""
    if fit.observability.null_directions or not np.isfinite(fit.covariance).all():
        return None
    sensor = fit.sensor
    return {
        "parameters": list(fit.parameter_names),
        "covariance": [[float(x) for x in row] for row in np.asarray(fit.covariance)],
        "noise": None if fit.noise is None else noise_to_dict(fit.noise),
        "pixel_sigma": float(fit.pixel_sigma),
        "smallest_singular_value": float(fit.observability.smallest_singular_value),
        **({} if sensor is None else {"depth_sensor": dataclasses.asdict(sensor)}),
    }


def load_estimate(path: str | os.PathLike[str]) -> SavedEstimate:
    """Read a calibration with its covariance from a file that `JointFit.save` wrote.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong entry, or a file without uncertainty; the message names the file.

    For example:

        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     fit.save(f"{folder}/calibration.yaml")
        ...     estimate = sv.load_estimate(f"{folder}/calibration.yaml")
        >>> estimate.parameter_names[5]
        'camera_from_tool.translation.x'
    """
    estimate = load_with_uncertainty(path)[1]
    if estimate is None:
        raise ValueError(
            f"{path}: uncertainty: missing; `fit.save` and `smartview calibrate` write it if all "
            "parameters are determined"
        )
    return estimate


def load_with_uncertainty(
    path: str | os.PathLike[str],
) -> tuple[Calibration, SavedEstimate | None]:
    """Read a calibration, with its covariance if the file has one.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: a wrong entry; the message names it and the file.
    """
    content = calibration_content(path)
    with errors_at(path):
        calibration = Calibration.from_dict(content)
        entry = content.get("uncertainty")
        return calibration, None if entry is None else _estimate_from_dict(calibration, entry)


def _estimate_from_dict(calibration: Calibration, entry: dict[str, Any]) -> SavedEstimate:
    """Return the estimate of a file's calibration and its entry `uncertainty`.

    Raises:
        ValueError: the calibration does not have a parameter of the entry.
    """
    names, known = tuple(entry["parameters"]), parameter_names(calibration)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"uncertainty: the calibration has no parameter {unknown[0]!r}")
    return SavedEstimate(
        calibration,
        np.array(entry["covariance"], dtype=float),
        names,
        noise_from_dict(entry.get("noise")),
        float(entry["pixel_sigma"]),
        Observability(len(names), len(names), (), (), float(entry["smallest_singular_value"])),
        None if entry.get("depth_sensor") is None else DepthSensor(**entry["depth_sensor"]),
    )


def noise_to_dict(noise: Noise) -> dict[str, Any]:
    """Return a noise model as plain numbers; None stands for infinity."""
    directions = noise.directions
    return {
        "pixel": float(noise.pixel),
        "translation": finite_or_null(noise.translation),
        "rotation": finite_or_null(noise.rotation),
        "field": [float(sigma) for sigma in noise.field],
        "white_pixel": None if noise.white_pixel is None else float(noise.white_pixel),
        **({} if directions is None else {"directions": _directions_to_dict(directions)}),
    }


def _directions_to_dict(directions: PoseDirections) -> dict[str, Any]:
    """Return the directions of errors as plain numbers."""
    return {
        "in_tool": [list(row) for row in directions.in_tool],
        "in_base": [list(row) for row in directions.in_base],
    }


def noise_from_dict(entry: dict[str, Any] | None) -> Noise | None:
    """Return the noise model of a file."""
    if entry is None:
        return None
    infinite, directions = float("inf"), entry.get("directions")
    return Noise(
        entry["pixel"],
        infinite if entry["translation"] is None else entry["translation"],
        infinite if entry["rotation"] is None else entry["rotation"],
        tuple(entry["field"]),
        entry.get("white_pixel"),
        None
        if directions is None
        else PoseDirections.of(np.array(directions["in_tool"]), np.array(directions["in_base"])),
    )
