"""Refuse a calibration or a camera that is not of a data set's camera and mount."""

from ..calibration import Calibration
from ..cameras import Camera
from .dataset import Dataset
from .pose_dataset import PoseDataset


def require_picture_size(what: str, camera: Camera, image_size: tuple[int, int]) -> None:
    """Raise a ValueError if a camera's pictures differ in size from the data's pictures."""
    if tuple(camera.image_size) != tuple(image_size):
        sizes = [" x ".join(map(str, size)) for size in (camera.image_size, image_size)]
        raise ValueError(
            f"{what} takes pictures of {sizes[0]} px, but the data have pictures of {sizes[1]} px"
            f"{_size_advice(camera.image_size, image_size)}"
        )


def _size_advice(known: tuple[int, int], given: tuple[int, int]) -> str:
    """Return what was done to pictures that have another size than a camera's, if it shows."""
    if tuple(known) == tuple(given)[::-1]:
        return ": were they turned by 90 degrees? Turn them back"
    factor = given[0] / known[0]
    binned = f"binned by {1.0 / factor:.3g} or " if factor < 1.0 else ""
    cut = "cut out (a region of interest has another u0 and v0, but the same focal length)"
    # Programs round the size of a picture up or down.
    if abs(given[1] - factor * known[1]) >= max(1.0, factor):
        return f": were they {cut}? Give a camera of these pictures, or leave it out"
    return (
        f": were they {binned}scaled by {factor:.3g} (then focal length, u0 and v0 are, too), or "
        f"{cut}? Give a camera of these pictures, or leave it out"
    )


def require_same_set_up(what: str, calibration: Calibration, data: Dataset) -> None:
    """Raise a ValueError for a calibration of another mount, or of pictures of another size."""
    if calibration.mount != data.mount:
        raise ValueError(f"mount: {what} is {calibration.mount}, but the data are {data.mount}")
    # Tracked poses have no pictures.
    if not isinstance(data, PoseDataset):
        require_picture_size(f"{what}'s camera", calibration.camera, data.image_size)
