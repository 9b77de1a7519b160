"""Name the cameras of a recording: one, which needs no name, or several."""

from collections.abc import Mapping

from ..dataset import RIG_NAME

ONE_CAMERA = ""
"""Name of the only camera of a recording, which needs none."""


def by_camera(image: str | Mapping[str, str] | None) -> dict[str, str | None]:
    """Return the source of each camera's pictures; one camera has the name `ONE_CAMERA`."""
    return dict(image) if isinstance(image, Mapping) else {ONE_CAMERA: image}


def check_cameras(image: str | Mapping[str, str] | None, kind: str) -> None:
    """Refuse names and sources of several cameras that cannot be told apart.

    Args:
        image: the source of the pictures, or of each camera's.
        kind: what a source is called, such as `"topic"`.
    """
    sources = by_camera(image)
    if wrong := [name for name in sources if name and not RIG_NAME.fullmatch(name)]:
        raise ValueError(
            f"image: a camera's name has letters, digits, '_' and '-'; found {wrong[0]!r}"
        )
    if isinstance(image, Mapping) and (not sources or ONE_CAMERA in sources):
        raise ValueError("image: expected a name for each camera")
    if len({source for source in sources.values() if source}) < len(sources) > 1:
        raise ValueError(f"image: expected another {kind} for each camera")
