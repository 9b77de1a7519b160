"""A camera as plain numbers with their names, as files have it."""

from typing import Any

from .camera import Camera
from .lens import AbstractLens
from .registry import lens_by_name, lens_name

_PINHOLE = ("alpha_u", "alpha_v", "u0", "v0")


def camera_to_dict(camera: Camera) -> dict[str, Any]:
    """Every number by name, px and lens."""
    lens = {name: float(value) for name, value in vars(camera.lens).items()}
    return {
        "image_size": list(camera.image_size),
        **{key: float(getattr(camera, key)) for key in _PINHOLE},
        "lens": {"model": lens_name(camera.lens), **lens},
    }


def camera_from_dict(content: dict[str, Any], lens: AbstractLens | None) -> Camera:
    """The inverse of `camera_to_dict`; `lens` stands for a model the library does not know.

    Raises:
        ValueError: other numbers than the lens has.
        KeyError: a number is missing.
    """
    numbers = dict(content["lens"])
    model = numbers.pop("model")
    template = lens_by_name(model) if lens is None else lens
    if set(numbers) != set(vars(template)):
        raise ValueError(
            f"camera.lens: expected the numbers {sorted(vars(template))}, found {sorted(numbers)}"
        )
    fitted = type(template)(**{name: float(value) for name, value in numbers.items()})
    width, height = content["image_size"]
    alpha_u, alpha_v, u0, v0 = (float(content[key]) for key in _PINHOLE)
    return Camera(alpha_u, alpha_v, u0, v0, fitted, (int(width), int(height)))
