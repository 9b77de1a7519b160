"""Search all pictures of a scene at one scale."""

from collections.abc import Sequence

from ..cameras import distinct_cameras, with_cameras
from ..features import PictureEvidence, scaled_camera
from ..modeling import SeenViews


def at_one_scale(
    pictures: Sequence[PictureEvidence], views: SeenViews
) -> tuple[tuple[PictureEvidence, ...], SeenViews]:
    """Return the evidence of all pictures at the scale of the sharpest one, and the views.

    The cameras of the returned views are the cameras of the resized pictures.

    Args:
        pictures: of all views.
        views: with the cameras that took them, or already with the resized pictures' cameras.
    """
    # Numbers that differ are refused by whatever looks into the pictures.
    both = list(zip(pictures, views.cameras, strict=False))
    if all(picture.features.image_size == camera.image_size for picture, camera in both):
        return tuple(pictures), views
    scale = max(picture.scale for picture in pictures)
    alike = tuple(picture.at(scale, camera) for picture, camera in both)
    scaled = [scaled_camera(camera, scale) for camera in distinct_cameras(views.camera)]
    return alike, views._replace(camera=with_cameras(views.camera, scaled))
