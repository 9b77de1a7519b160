"""Search all pictures of a scene at one scale."""

from collections.abc import Sequence

from ..features import PictureEvidence, scaled_camera
from ..modeling import SeenViews


def at_one_scale(
    pictures: Sequence[PictureEvidence], views: SeenViews
) -> tuple[tuple[PictureEvidence, ...], SeenViews]:
    """Return the evidence of all pictures at the scale of the sharpest one, and the views.

    The camera of the returned views is the camera of the reduced pictures.

    Args:
        pictures: of all views.
        views: with the camera that took them, or already with the camera of the reduced pictures.
    """
    size = views.camera.image_size
    if not len(pictures) or all(picture.features.image_size == size for picture in pictures):
        return tuple(pictures), views
    scale = max(picture.scale for picture in pictures)
    alike = tuple(picture.at(scale, views.camera) for picture in pictures)
    return alike, views._replace(camera=scaled_camera(views.camera, scale))
