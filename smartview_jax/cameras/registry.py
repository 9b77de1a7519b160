"""Lenses by name."""

import equinox as eqx
import jax.numpy as jnp

from ..schemas.words import nearest
from .fisheye import Fisheye
from .lens import AbstractLens
from .opencv import OpenCV4, OpenCV5, OpenCV8
from .pinhole import Pinhole
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


def lens_by_name(name: str | AbstractLens) -> AbstractLens:
    """The named lens without distortion; a lens is returned as it is.

    Raises:
        ValueError: an unknown name; the message lists those there are.
    """
    if isinstance(name, AbstractLens):
        return name
    if name not in LENSES:
        raise ValueError(
            f"lens is one of {', '.join(LENSES)}, or an AbstractLens; found {name!r}"
            f"{nearest(name, LENSES)}"
        )
    return LENSES[name]()


def lens_name(lens: AbstractLens) -> str:
    """The name of a lens; for a lens of one's own, its class name."""
    for name, kind in LENSES.items():
        if type(lens) is kind:
            return name
    return type(lens).__name__


def start_lens(name: str | AbstractLens, known: AbstractLens) -> AbstractLens:
    """The lens called `name`, as a start for a fit, from what another model is known to do.

    The models disagree on direction: the paper's and Weng's map distorted to ideal coordinates, so
    a small k1 there is about -k1 of OpenCV's. A lens of one's own starts as it is given.
    """
    lens = lens_by_name(name)
    if type(lens) is type(known):
        return known
    inverse = (Radial, Weng)
    own = not isinstance(name, str)
    if own or isinstance(lens, Pinhole | Fisheye) or isinstance(known, Fisheye):
        return lens
    k1 = getattr(known, "k1", jnp.zeros(()))
    same = isinstance(lens, inverse) == isinstance(known, inverse)
    return eqx.tree_at(lambda model: model.k1, lens, k1 if same else -k1)
