"""Read pictures from cameras and video files by OpenCV, and from a folder that fills up."""

import os
import time
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from ..detection import read_picture
from ..io import is_picture_name
from .sources import SourceLostError

BUFFERED_FRAMES = 4
"""Number of frames that a camera's driver keeps at most; older than a motion that just ended."""

STABLE_SECONDS = 0.3
"""Time for which the size of a file must not change to count as written completely, s."""


class OpenCVCamera:
    """A camera by OpenCV's index: USB cameras, built-in cameras, and what looks like one."""

    is_continuous: bool = True

    def __init__(self, index: int):
        """Open the camera; raise a SourceLostError if there is none."""
        self._name = f"camera {index}"
        self._capture = _opened(index, self._name)

    def read(self) -> UInt8[np.ndarray, "..."]:
        """Return a new picture."""
        # The driver's buffer still has pictures from before the call.
        for _ in range(BUFFERED_FRAMES):
            if not self._capture.grab():
                raise SourceLostError(f"{self._name} gives no picture")
        is_read, picture = self._capture.retrieve()
        if not is_read:
            raise SourceLostError(f"{self._name} gives no picture")
        return np.asarray(picture, dtype=np.uint8)

    def close(self) -> None:
        """Release the camera."""
        self._capture.release()


class VideoFile:
    """A video file, or a stream's address, whose frames are read one after another."""

    is_continuous: bool = True

    def __init__(self, path: str | os.PathLike[str]):
        """Open the video; raise a SourceLostError if it cannot be opened."""
        self._name = str(path)
        self._capture = _opened(self._name, self._name)
        self._last: np.ndarray | None = None

    def read(self) -> UInt8[np.ndarray, "..."]:
        """Return the next frame; at the end of the file the last one again."""
        is_read, picture = self._capture.read()
        if is_read:
            self._last = np.asarray(picture, dtype=np.uint8)
        if self._last is None:
            raise SourceLostError(f"{self._name}: no frame can be read")
        return self._last

    def close(self) -> None:
        """Close the file."""
        self._capture.release()


def _opened(source: int | str, name: str) -> cv2.VideoCapture:
    """Return an open capture of OpenCV."""
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        capture.release()
        raise SourceLostError(f"{name} cannot be opened")
    return capture


class PictureFolder:
    """A folder into which another program writes pictures; the newest one is read."""

    is_continuous: bool = False

    def __init__(self, folder: str | os.PathLike[str]):
        """Store the folder; raise a SourceLostError if there is none."""
        self._folder = Path(folder)
        if not self._folder.is_dir():
            raise SourceLostError(f"{folder}: no such folder")

    def read(self) -> UInt8[np.ndarray, "..."]:
        """Return the newest picture that is written completely."""
        try:
            return read_picture(self._newest())
        except (OSError, ValueError) as error:
            raise SourceLostError(str(error)) from error

    def _newest(self) -> Path:
        """Return the newest picture that is complete."""
        dated_files = [
            (path.stat().st_mtime, path) for path in self._folder.iterdir() if is_picture_name(path)
        ]
        # A file that is still being written has just been changed.
        complete = [entry for entry in dated_files if time.time() - entry[0] >= STABLE_SECONDS]
        if not complete:
            raise SourceLostError(f"{self._folder}: no picture yet")
        return max(complete)[1]

    def close(self) -> None:
        """Do nothing; a folder needs no closing."""
