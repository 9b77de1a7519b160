"""Lenses by name."""

from .lens import AbstractLens
from .pinhole import Pinhole
from .radial import Radial

LENSES = {"pinhole": Pinhole, "radial": Radial}


def lens_by_name(name: str | AbstractLens) -> AbstractLens:
    """The named lens without distortion; a lens is returned as it is."""
    if isinstance(name, AbstractLens):
        return name
    if name not in LENSES:
        raise ValueError(f"lens is one of {', '.join(LENSES)}, or an AbstractLens; found {name!r}")
    return LENSES[name]()


def lens_name(lens: AbstractLens) -> str:
    """The name of a lens; for a lens of one's own, its class name."""
    for name, kind in LENSES.items():
        if type(lens) is kind:
            return name
    return type(lens).__name__
