"""Define the options that state prior knowledge, and read their texts."""

import dataclasses
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import typer

import smartview_jax as sv

from ..argument_checks import NUMBER_PATTERN, errors_at
from ..files import read_yaml

if TYPE_CHECKING:
    from jaxlie import SE3


CameraOption = Annotated[
    Path | None,
    typer.Option(
        help="File of a known camera, which is held, such as calibration.yaml, or of OpenCV, ROS "
        "(camera_info), Kalibr, mrcal or ViSP. A single tag (four corners) then suffices. Of "
        "several cameras: a folder with left.yaml and so on, or Kalibr's camchain.yaml."
    ),
]
FixedOption = Annotated[
    list[str] | None,
    typer.Option(
        help="A parameter to hold at its start, such as camera.lens or "
        "camera_from_tool.rotation. May be repeated."
    ),
]
FreeOption = Annotated[
    list[str] | None,
    typer.Option(
        help="A parameter to estimate that is held by default, such as target_scale. May be "
        "repeated."
    ),
]
PriorOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Prior of a parameter: NAME=VALUE+-SIGMA with its unit (px, mm, m, deg, rad), such "
        "as camera.u0=640+-5px or camera_from_tool.translation.x=12+-2mm; NAME=+-SIGMA is centred "
        "on the start; or a YAML file of such lines. Square pixels: camera.pixel_aspect=1+-0.001, "
        "the ratio of the focal lengths (1+-1e-9: one focal length). Of several cameras this ratio "
        "alone, of all or as left.camera.pixel_aspect. May be repeated."
    ),
]
StartOption = Annotated[
    list[str] | None,
    typer.Option(
        help="Start of the joint fit: a calibration.yaml, or a rough transform as "
        "camera_from_tool=x,y,z,yaw,pitch,roll in m and degrees, such as "
        "camera_from_tool=0,0.05,0.06,90,0,0 (or its inverse, tool_from_camera). Of several "
        "cameras: a folder with left.yaml and so on, or left.camera_from_tool=... May be repeated."
    ),
]

_LENGTHS = {"mm": 1e-3, "m": 1.0}
_ANGLES = {"deg": math.radians(1.0), "rad": 1.0}
_UNITS = {"mm": _LENGTHS, "deg": _ANGLES, "px": {"px": 1.0}, "": {"": 1.0}}
"""Factors to the library's units, by the unit in which a parameter is printed."""

_PRIOR = re.compile(rf"\s*({NUMBER_PATTERN})?\s*(?:\+-|±)\s*({NUMBER_PATTERN})\s*([a-z]*)\s*")
"""A value, which may be missing, its standard deviation, and their unit."""


@dataclass(frozen=True)
class FitKnowledge:
    """The options of a fitting subcommand that state prior knowledge."""

    camera: CameraOption = None
    fixed: FixedOption = None
    free: FreeOption = None
    prior: PriorOption = None
    start: StartOption = None


class FitOptions(NamedTuple):
    """Prior knowledge for `calibrate`.

    Attributes:
        camera: a known camera; None to estimate it.
        start: where the joint fit starts; None for the staged fit's calibration.
        fixed: paths of parameters that keep their start.
        free: paths of parameters that are held by default.
        priors: priors by path.
        given: the options in words, for the files of a run; empty where there are none.
    """

    camera: "sv.Camera | None" = None
    start: "sv.Calibration | dict[str, SE3] | None" = None
    fixed: tuple[str, ...] = ()
    free: tuple[str, ...] = ()
    priors: "dict[str, sv.Prior] | None" = None
    given: str = ""

    def arguments(self) -> dict[str, Any]:
        """Return the keyword arguments of `calibrate`, without options that were not given."""
        named = {key: getattr(self, key) for key in ("camera", "start", "fixed", "free", "priors")}
        return {key: value for key, value in named.items() if value}


def parse_fit_options(lens: str, mount: str, known: FitKnowledge) -> FitOptions:
    """Read the texts of the options; every error names the option and what it expects."""
    # Before anything is detected or fitted, so that a misspelt name is reported at once.
    camera = None if known.camera is None else sv.io.read_camera(known.camera)
    fixed, free = tuple(known.fixed or ()), tuple(known.free or ())
    units = _units_by_name(lens, mount, camera)
    with errors_at("--fixed, --free"):
        sv.engine.ParameterChoice.of(fixed, free)
    for option, paths in (("--fixed", fixed), ("--free", free)):
        for path in paths:
            _names_of(option, path, units)
    priors = dict(_parse_prior(text, units) for text in _prior_texts(known.prior or ()))
    freed = free + tuple(path for path in priors if path == "target_scale")
    _refuse_contradictions(camera is not None, fixed, free, priors, units)
    return FitOptions(
        camera,
        _parse_start(known.start or (), mount),
        fixed,
        # A prior has no effect on a held parameter, so stating one frees the parameter.
        tuple(dict.fromkeys(freed)),
        priors or None,
        _in_words(known),
    )


def _in_words(known: FitKnowledge) -> str:
    """Return the options as a person would write them, always in the same order."""
    texts = [("camera", () if known.camera is None else (str(known.camera),))]
    texts += [(name, getattr(known, name) or ()) for name in ("fixed", "free", "prior", "start")]
    return ", ".join(f"--{name} {text}" for name, listed in texts for text in listed)


def _units_by_name(lens: str, mount: str, camera: "sv.Camera | None") -> dict[str, str]:
    """Return the names of the parameters of such a fit, with the unit in which each is shown."""
    # Any camera of this lens: only the names are used.
    template = camera or sv.Camera(
        1e3, 1e3, 320.0, 240.0, sv.cameras.lens_by_name(lens), (640, 480)
    )
    # By NumPy: jaxlie's identity would be a program to compile.
    anywhere = sv.geometry.host_transforms(np.eye(4))
    bases = (
        anywhere if sv.calibration.BASES in sv.calibration.chain_transform_names(mount) else None
    )
    calibration = sv.Calibration(template, anywhere, anywhere, mount, base_from_other_base=bases)
    return {name: unit for name, (_, unit) in sv.joint.displayed_values(calibration).items()}


def _names_of(option: str, path: str, units: dict[str, str]) -> list[str]:
    """Return the names that a path selects, or raise a ValueError that suggests similar ones."""
    with errors_at(option):
        mask = sv.engine.parameter_mask(tuple(units), (path,))
    return [name for name, selected in zip(units, mask, strict=True) if selected]


def _prior_texts(texts: Sequence[str]) -> list[str]:
    """Return the priors as NAME=VALUE+-SIGMA, with each file replaced by its lines."""
    lines = []
    for text in texts:
        if "=" in text:
            lines.append(text)
        elif not Path(text).is_file():
            raise ValueError(
                f"--prior: expected NAME=VALUE+-SIGMA, such as camera.u0=640+-5px, or a YAML file; "
                f"found {text!r}"
            )
        else:
            lines += [f"{name}={value}" for name, value in read_yaml(text).items()]
    return lines


def _parse_prior(text: str, units: dict[str, str]) -> "tuple[str, sv.Prior]":
    """Return the path and the prior of NAME=VALUE+-SIGMA, in the library's units."""
    path, _, value = text.partition("=")
    names = _names_of("--prior", path.strip(), units)
    # A ratio of lengths in px has no unit.
    shown = {"" if sv.engine.is_aspect(path.strip()) else units[name] for name in names}
    # A path such as camera_from_tool covers lengths and angles, which have no common unit.
    match = _PRIOR.fullmatch(value)
    if match is None or len(shown) != 1:
        reason = "it has several units" if len(shown) != 1 else f"found {value!r}"
        raise ValueError(f"--prior {path}: expected VALUE+-SIGMA in a single unit; {reason}")
    # Without a mean the prior is centred on the start, as it always is for rotations.
    mean, std, unit = match.groups()
    factors = _UNITS[shown.pop()]
    # Units are never guessed, so that millimetres are not taken for metres.
    if unit not in factors:
        raise ValueError(
            f"--prior {path}: expected a unit, {' or '.join(factors) or 'none'}, as in "
            f"{path}=1+-0.1{next(iter(factors))}; found {value!r}"
        )
    if not float(std) > 0.0:
        raise ValueError(f"--prior {path}: expected a positive SIGMA, found {std}")
    scale = factors[unit]
    return path.strip(), sv.Prior(
        std=scale * float(std), mean=None if mean is None else scale * float(mean)
    )


def _refuse_contradictions(
    camera_is_known: bool,
    fixed: tuple[str, ...],
    free: tuple[str, ...],
    priors: "dict[str, sv.Prior]",
    units: dict[str, str],
) -> None:
    held = {name for path in fixed for name in _names_of("--fixed", path, units)}
    # A known camera is held as a whole.
    if camera_is_known:
        held |= set(_names_of("--camera", "camera", units))
    for option, paths in (("--free", free), ("--prior", tuple(priors))):
        for path in paths:
            if set(_names_of(option, path, units)) & held:
                raise ValueError(f"{option} {path}: it is held by --fixed or --camera")
    # An option without effect is an error, so that nobody believes that it changed the fit.
    for path in free:
        if path != "target_scale":
            raise ValueError(f"--free {path}: it is free already; by default target_scale is held")
    for path, prior in priors.items():
        if prior.mean is not None and any(".rotation." in x for x in _names_of("", path, units)):
            # Rotation vectors have no mean that a person could state.
            raise ValueError(
                f"--prior {path}: a prior on a rotation is centred on its start: give "
                f"{path}=+-1deg and --start"
            )


def _parse_start(texts: Sequence[str], mount: str) -> "sv.Calibration | dict[str, SE3] | None":
    """Return the start of the joint fit: the transforms given, in a file's calibration if any."""
    files = [text for text in texts if "=" not in text]
    if len(files) > 1:
        raise ValueError(f"--start: one calibration file, found {files[1]!r} too")
    transforms = parse_transforms([text for text in texts if "=" in text], mount)
    if not files:
        return transforms or None
    # Transforms of the options replace the file's, in whatever order they were given.
    attributes = ("camera_from_mount", "holder_from_world", sv.calibration.BASES)
    parts = dict(zip(sv.calibration.chain_transform_names(mount), attributes, strict=False))
    changed = {parts[name]: pose for name, pose in transforms.items()}
    return dataclasses.replace(sv.Calibration.load(files[0]), **changed)


def parse_rig_start(
    texts: Sequence[str], mounts: Mapping[str, str]
) -> "dict[str, sv.Calibration | dict[str, SE3]] | None":
    """Return the starts of a rig's cameras by name; None without any.

    A text is a folder with a calibration for each camera, or CAMERA.NAME=x,y,z,yaw,pitch,roll.
    """
    folders = [Path(text) for text in texts if "=" not in text]
    if len(folders) > 1:
        raise ValueError(f"--start: one folder of calibrations, found {folders[1]} too")
    entries: dict[str, list[str]] = {name: [] for name in mounts}
    for folder in folders:
        for name, listed in entries.items():
            file = folder / f"{name}.yaml"
            if not file.is_file():
                raise ValueError(f"--start: {file}: missing, the calibration of camera {name}")
            listed.append(str(file))
    for text in texts:
        if "=" not in text:
            continue
        name, _, transform = text.partition(".")
        if name not in entries or "=" in name:
            raise ValueError(
                f"--start: expected CAMERA.TRANSFORM=... with a camera of {', '.join(entries)}, "
                f"found {text!r}"
            )
        entries[name].append(transform)
    starts = {name: _parse_start(listed, mounts[name]) for name, listed in entries.items()}
    return {name: start for name, start in starts.items() if start is not None} or None


def parse_rig_aspects(
    texts: Sequence[str], cameras: Collection[str], known: Collection[str] = ()
) -> "dict[str, sv.Prior]":
    """Return the priors on the ratios of focal lengths of a rig's unknown cameras, by path.

    A text is camera.pixel_aspect=1+-0.001 for all cameras, or left.camera.pixel_aspect for one.
    """
    if texts and set(cameras) <= set(known):
        raise ValueError(f"--prior {texts[0]}: every camera is held by --camera")
    whole = sv.engine.PIXEL_ASPECT
    fitted = [name for name in cameras if name not in known]
    units = {sv.engine.alpha_v_of(path): "" for path in (whole, *_aspects_of(fitted))}
    priors: dict[str, sv.Prior] = {}
    parsed = [_parse_prior(text, units) for text in _prior_texts(texts)]
    # What is said of one camera holds against what is said of all, in whatever order.
    for path, prior in sorted(parsed, key=lambda entry: entry[0] != whole):
        if not sv.engine.is_aspect(path):
            raise ValueError(f"--prior {path}: of several cameras only {whole} has a prior")
        priors |= dict.fromkeys(_aspects_of(fitted) if path == whole else [path], prior)
    return priors


def _aspects_of(cameras: Sequence[str]) -> list[str]:
    """Return the path of the ratio of focal lengths of each camera of a rig."""
    return [f"{name}.{sv.engine.PIXEL_ASPECT}" for name in cameras]


def parse_transforms(texts: Sequence[str], mount: str) -> "dict[str, SE3]":
    """Return rough transforms by name from NAME=x,y,z,yaw,pitch,roll (m, degrees)."""
    names, transforms = sv.calibration.chain_transform_names(mount), {}
    for text in texts:
        name, _, pose = text.partition("=")
        # Drawings state either direction: camera_from_tool or its inverse, tool_from_camera.
        reverse = "_from_".join(reversed(name.split("_from_")))
        if name not in names and reverse not in names:
            raise ValueError(f"--start: expected {' or '.join(names)} before =, found {name!r}")
        rough_pose = sv.io.parse_rough_pose(f"--start {name}", pose)
        transforms[name if name in names else reverse] = (
            rough_pose if name in names else rough_pose.inverse()
        )
    return transforms
