"""Find lens models by name, start one model from another, and read and write cameras."""

from typing import Any

import equinox as eqx
import numpy as np

from ..argument_checks import require_one_of
from ..runtime.array_namespace import as_float_array
from .camera import Camera
from .fisheye import Fisheye
from .lens import AbstractLens, Pinhole
from .opencv import OpenCV4, OpenCV5, OpenCV8
from .radial import Radial
from .weng import Weng

LENSES: dict[str, type[AbstractLens]] = {
    "pinhole": Pinhole,
    "radial": Radial,
    "weng": Weng,
    "opencv4": OpenCV4,
    "opencv5": OpenCV5,
    "opencv8": OpenCV8,
    "fisheye": Fisheye,
}
"""Class of every known lens model, by name."""

_PINHOLE_PARAMETERS = ("alpha_u", "alpha_v", "u0", "v0")
"""The names of a camera's pinhole parameters, px."""


def lens_by_name(name: str | AbstractLens) -> AbstractLens:
    """Return the named lens with all coefficients zero; a lens is returned unchanged.

    Raises:
        ValueError: an unknown name; the message lists the known ones.
    """
    if isinstance(name, AbstractLens):
        return name
    require_one_of("lens", name, LENSES, ", or an AbstractLens")
    return LENSES[name]()


def lens_name(lens: AbstractLens) -> str:
    """Return the name of a lens model; for a user's own lens, its class name."""
    for name, kind in LENSES.items():
        if type(lens) is kind:
            return name
    return type(lens).__name__


def initial_lens(name: str | AbstractLens, fitted: AbstractLens) -> AbstractLens:
    """Return a lens of the named model as the start of a fit, given a fitted lens of another model.

    A lens of the same model is returned unchanged. Of another model only k1 is transferred. The
    models differ in direction: the paper's and Weng's map distorted to ideal coordinates, so that a
    small k1 there is about -k1 of OpenCV's. A fisheye starts without distortion, as does every
    model after a fisheye. A user's own lens starts as it is given.

    Args:
        name: a key of `LENSES`, or a lens.
        fitted: the fitted lens.
    """
    lens = lens_by_name(name)
    if type(lens) is type(fitted):
        return fitted
    undistorting_models = (Radial, Weng)
    is_user_lens = not isinstance(name, str)
    if is_user_lens or isinstance(lens, Pinhole | Fisheye) or isinstance(fitted, Fisheye):
        return lens
    # To first order in k1, the inverse of  x' = x (1 + k1 |x|^2)  is  x = x' (1 - k1 |x'|^2), so
    # that k1 changes its sign where the directions differ. A pinhole has none: it counts as zero.
    k1 = np.asarray(getattr(fitted, "k1", 0.0))
    same_direction = isinstance(lens, undistorting_models) == isinstance(
        fitted, undistorting_models
    )
    return eqx.tree_at(lambda model: model.k1, lens, as_float_array(k1 if same_direction else -k1))


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Return all parameters of a camera by name: pinhole parameters (px) and lens coefficients."""
    lens = {name: float(value) for name, value in vars(camera.lens).items()}
    return {
        "image_size": list(camera.image_size),
        **{key: float(getattr(camera, key)) for key in _PINHOLE_PARAMETERS},
        "lens": {"model": lens_name(camera.lens), **lens},
    }


def camera_from_dict(content: dict[str, Any], lens: AbstractLens | None) -> Camera:
    """Return the camera that a mapping describes, the inverse of `camera_to_dict`.

    Args:
        content: the mapping.
        lens: a lens of the mapping's model, needed for a user's own model; None for the models of
            this library.

    Raises:
        ValueError: an unknown lens model, or names of numbers that are not the lens's names.
        KeyError: a number is missing.
    """
    # The coefficients of a lens are its attributes, so a template of its model has their names.
    numbers = dict(content["lens"])
    model = numbers.pop("model")
    template = lens_by_name(model) if lens is None else lens
    if set(numbers) != set(vars(template)):
        raise ValueError(
            f"camera.lens: expected the numbers {sorted(vars(template))}, found {sorted(numbers)}"
        )
    fitted = type(template)(**{name: float(value) for name, value in numbers.items()})
    width, height = content["image_size"]
    alpha_u, alpha_v, u0, v0 = (float(content[key]) for key in _PINHOLE_PARAMETERS)
    return Camera(alpha_u, alpha_v, u0, v0, fitted, (int(width), int(height)))
