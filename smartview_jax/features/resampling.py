"""Resample a picture to the one that another camera in the same place would have taken."""

import cv2
import numpy as np
from jaxtyping import UInt8

from ..cameras import Camera
from .ideal_plane import IdealPlane


def resampled(
    picture: UInt8[np.ndarray, "rows columns *channels"], camera: Camera, target: Camera
) -> UInt8[np.ndarray, "height width *channels"]:
    """Return the picture that another camera in the same place would have taken.

    Args:
        picture: uint8, grey or BGR.
        camera: the camera that took it.
        target: intrinsics, lens and picture size of the other camera.

    Raises:
        ValueError: the picture is not of the camera's size.
    """
    width, rows = camera.image_size
    if picture.shape[:2] != (rows, width):
        raise ValueError(
            f"picture: expected {width} x {rows} px, the camera's size, found "
            f"{picture.shape[1]} x {picture.shape[0]} px"
        )
    columns, height = target.image_size
    pixels = np.stack(np.meshgrid(np.arange(columns), np.arange(height)), axis=-1).astype(float)
    # Both ideal planes have the same rays, each at its own focal length.
    source_plane, target_plane = IdealPlane(camera), IdealPlane(target)
    ideal = target_plane.from_pixels(pixels.reshape(-1, 2)) * (
        source_plane.focal_length / target_plane.focal_length
    )
    places = np.nan_to_num(source_plane.to_pixels(np.nan_to_num(ideal))[0], nan=-1e4)
    u, v = np.moveaxis(places.reshape(height, columns, 2).astype(np.float32), -1, 0)
    # The border is replicated: a constant there would look like an edge.
    return cv2.remap(picture, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(
        np.uint8
    )
