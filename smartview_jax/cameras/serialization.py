"""Convert cameras to and from the mappings of plain numbers that files contain."""

from typing import Any

from .camera import Camera
from .lens import AbstractLens
from .registry import lens_by_name, lens_name

_PINHOLE_PARAMETERS = ("alpha_u", "alpha_v", "u0", "v0")
"""The names of a camera's pinhole parameters, px."""


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
