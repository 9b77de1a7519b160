"""Write the calibrations of a rig with their joint covariance to a folder, and read them back.

The errors of the cameras of a rig are correlated: pictures of several cameras tell less, or more,
than each camera's own covariance says.
"""

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..calibration import Calibration
from ..engine import Noise, parameter_names
from ..files import read_yaml
from .saved_estimate import noise_from_dict, noise_to_dict

if TYPE_CHECKING:
    from .rig_fit import RigFit

RIG_FILE = "rig.joint.yaml"
"""Name of the file of a rig, in the folder of its cameras' calibration files.

No camera's file is called so, since the name of a camera has no point.
"""

JOINT_SUFFIX = ".joint.yaml"
"""End of the names of these files: each of several arms has one, called by the arm's name."""


class RigEstimate(NamedTuple):
    """The calibrations of a rig's cameras, with the joint covariance of their parameters.

    Attributes:
        calibrations: calibration of each camera, by its name.
        covariance: covariance of the parameters that were estimated, in their own units.
        parameter_names: names of these parameters, as in `RigFit`.
        camera_names: by camera, the rig's name of each of its parameters, in their order.
        noise: standard deviations of pixels and reported poses.
    """

    calibrations: Mapping[str, Calibration]
    covariance: Float[np.ndarray, "free free"]
    parameter_names: tuple[str, ...]
    camera_names: Mapping[str, tuple[str, ...]]
    noise: Noise

    @classmethod
    def of(cls, fit: "RigFit", arm: str | None = None) -> "RigEstimate":
        """Return the part of a fit that its files have.

        Args:
            fit: joint fit of a rig.
            arm: name of one of several arms, whose cameras are taken; as they are known by the fit
                of all. Their parameters are named as in the fit of this arm alone.

        Raises:
            ValueError: a parameter is undetermined, and the message names it; or several arms and
                none or an unknown one is named.
        """
        if arm is None and len(fit.noises) > 1:
            raise ValueError(
                f"expected the fit of a rig with one arm, found {', '.join(fit.noises)}: pictures "
                "are localised, and states planned, in the frames of one robot: name it"
            )
        arm = next(iter(fit.noises)) if arm is None else arm
        if arm not in fit.noises:
            raise ValueError(f"expected an arm of {', '.join(fit.noises)}, found {arm!r}")
        names, covariance, std = fit.of_arm(arm)
        undetermined = [n for n, sigma in zip(names, std, strict=True) if not np.isfinite(sigma)]
        if undetermined:
            raise ValueError(
                f"the data do not determine {', '.join(undetermined)}; add views or a prior"
            )
        calibrations = _calibrations_of(fit, arm)
        camera_names = _camera_names(fit, arm)
        return cls(calibrations, np.asarray(covariance), names, camera_names, fit.noises[arm])


def _calibrations_of(fit: "RigFit", arm: str) -> dict[str, Calibration]:
    """Return the calibrations of one arm's cameras."""
    return {name: entry for name, entry in fit.calibrations.items() if fit.arms[name] == arm}


def _camera_names(fit: "RigFit", arm: str) -> dict[str, tuple[str, ...]]:
    """Return the arm's name of each parameter of each of its cameras' calibrations."""
    built, names = fit.built_by_arm[arm], {}
    for camera, calibration in _calibrations_of(fit, arm).items():
        # The least-squares problem may have more terms of the robot's error than the result.
        local = parameter_names(built.starts[camera])
        number_of = dict(zip(local, built.camera_names[camera], strict=True))
        names[camera] = tuple(number_of[name] for name in parameter_names(calibration))
    return names


def rig_files(arms: Iterable[str]) -> dict[str, str]:
    """Return the name of the file of each arm's cameras; of the only arm, `RIG_FILE`."""
    names = list(arms)
    return {arm: RIG_FILE if len(names) == 1 else f"{arm}{JOINT_SUFFIX}" for arm in names}


def save_rig(fit: "RigFit", folder: Path, run: str | None) -> None:
    """Write the file of a rig, or of each arm; without uncertainty of an undetermined parameter."""
    # The validation library is imported only where files are read or written.
    from ..schemas.calibrated_rig import CALIBRATED_RIG_SCHEMA, END_MARK
    from ..schemas.validation import write_validated

    for arm, file in rig_files(fit.noises).items():
        known = np.isfinite(fit.of_arm(arm)[2]).all()
        content = {
            "smartview_rig": 1,
            "run": run,
            "cameras": {name: f"{name}.yaml" for name in _calibrations_of(fit, arm)},
            "parameters_of": {
                name: list(listed) for name, listed in _camera_names(fit, arm).items()
            },
            "uncertainty": rig_uncertainty_to_dict(fit, arm) if known else None,
            "end": END_MARK,
        }
        write_validated(folder / file, content, CALIBRATED_RIG_SCHEMA)


def rig_uncertainty_to_dict(fit: "RigFit", arm: str) -> dict[str, Any]:
    """Return the joint covariance and the noise of an arm's cameras as plain numbers."""
    names, covariance, _ = fit.of_arm(arm)
    noise = fit.noises[arm]
    return {
        "parameters": list(names),
        "covariance": [[float(x) for x in row] for row in np.asarray(covariance)],
        "noise": noise_to_dict(noise),
        "pixel_sigma": float(noise.pixel),
        "smallest_singular_value": float(fit.smallest_singular_value),
    }


def load_rig_estimate(path: str | os.PathLike[str]) -> RigEstimate:
    """Read the calibrations of a rig with their joint covariance, as `RigFit.save` wrote them.

    Args:
        path: the folder, or the file `rig.joint.yaml` in it; of several arms, the file of one arm,
            such as `left.joint.yaml`.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a wrong entry, or a rig without uncertainty; the message names the file.

    For example, with one camera in the place of two:

        >>> import tempfile
        >>> rig = sv.Rig({"left": data, "right": data.select(range(4))})
        >>> both = sv.fit_rig(rig, {"left": truth, "right": truth}, noise=noise)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     both.save(folder)
        ...     read = sv.load_rig_estimate(folder)
        >>> sv.RigViews(read, ["left", "right"])
        <RigViews: left, right; world frame, with their joint covariance>
    """
    calibrations, estimate = load_calibrated_rig(path)
    if estimate is None:
        raise ValueError(
            f"{path}: uncertainty: missing, since the data did not determine all parameters of "
            f"{', '.join(calibrations)}"
        )
    return estimate


def load_calibrated_rig(
    path: str | os.PathLike[str],
) -> tuple[dict[str, Calibration], RigEstimate | None]:
    """Read the calibrations of a rig, with their joint covariance if the rig's file has one.

    Raises:
        FileNotFoundError: a file is missing.
        ValueError: a wrong entry; the message names it and the file.
    """
    from ..schemas.calibrated_rig import CALIBRATED_RIG_SCHEMA
    from ..schemas.validation import validate_content

    file = Path(path) / RIG_FILE if Path(path).is_dir() else Path(path)
    content = validate_content(read_yaml(file), CALIBRATED_RIG_SCHEMA, file)
    calibrations = {
        n: Calibration.load(file.parent / listed) for n, listed in content.cameras.items()
    }
    of_cameras = {name: tuple(listed) for name, listed in content.parameters_of.items()}
    for name, calibration in calibrations.items():
        expected = len(parameter_names(calibration))
        if len(of_cameras[name]) != expected:
            raise ValueError(
                f"{file}: parameters_of.{name}: expected names of the {expected} parameters in "
                f"{content.cameras[name]}, found {len(of_cameras[name])}"
            )
    entry = content.uncertainty
    if entry is None:
        return calibrations, None
    noise = noise_from_dict(entry.model_dump()["noise"])
    assert noise is not None
    covariance = np.array(entry.covariance, dtype=float)
    return calibrations, RigEstimate(
        calibrations, covariance, tuple(entry.parameters), of_cameras, noise
    )


def is_rig(path: str | os.PathLike[str]) -> bool:
    """Return whether a path is the folder of a calibrated rig, or a file `rig.joint.yaml` in it."""
    place = Path(path)
    return (place / RIG_FILE).is_file() if place.is_dir() else place.name.endswith(JOINT_SUFFIX)
