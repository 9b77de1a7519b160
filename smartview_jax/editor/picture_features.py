"""Find the features of each picture once, when first needed."""

import threading
from collections.abc import Mapping

import numpy as np

from ..cameras import Camera
from ..features import Features
from ..features import find as find_features


class PictureFeatures:
    """The features of a session's pictures, found on first use."""

    def __init__(self, cameras: Mapping[str, Camera], pictures: Mapping[str, np.ndarray]):
        """Take the cameras and the pictures by view."""
        self._cameras, self._pictures = cameras, pictures
        self._found: dict[str, Features] = {}
        self._finding = {name: threading.Lock() for name in pictures}

    def of(self, view: str) -> Features:
        """Return the corners and segments found in a view's picture, which clicks snap to.

        Raises:
            ValueError: the picture is blank, over-exposed or under-exposed; the view is named.
        """
        # A page may ask for them while a thread of the server prepares them.
        with self._finding[view]:
            if view not in self._found:
                try:
                    camera = self._cameras[view]
                    self._found[view] = find_features(self._pictures[view], camera)
                except ValueError as error:
                    raise ValueError(f"view {view}: {error}") from None
        return self._found[view]
