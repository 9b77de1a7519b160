"""Find the features of each picture once, whoever asks for them first."""

import threading
from collections.abc import Mapping

import numpy as np

from ..cameras import Camera
from ..features import Features
from ..features import find as find_features


class PictureFeatures:
    """The features of a session's pictures, found when they are asked for."""

    def __init__(self, camera: Camera, pictures: Mapping[str, np.ndarray]):
        """Take the pictures by view."""
        self._camera, self._pictures = camera, pictures
        self._found: dict[str, Features] = {}
        self._finding = {name: threading.Lock() for name in pictures}

    def of(self, view: str) -> Features:
        """Return the corners and segments found in a view's picture, which clicks snap to.

        Raises:
            ValueError: the picture is blank, over-exposed or under-exposed; the view is named.
        """
        # The page asks for them while a server's thread prepares them: one waits for the other.
        with self._finding[view]:
            if view not in self._found:
                try:
                    self._found[view] = find_features(self._pictures[view], self._camera)
                # Of several pictures, one may be of a lens cap.
                except ValueError as error:
                    raise ValueError(f"view {view}: {error}") from None
        return self._found[view]
