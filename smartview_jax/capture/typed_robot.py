"""Take the robot's pose as a person types or pastes it, in any pose format of the package."""

import re
import threading

import numpy as np
from jaxtyping import Float

from ..argument_checks import NUMBER_PATTERN
from ..geometry import PoseCodec, host_matrices, pose_codec
from .sources import SourceLostError

_SEPARATORS = re.compile(r"[\s,;=:()\[\]{}]+")


def parse_pose(text: str, codec: PoseCodec) -> Float[np.ndarray, "4 4"]:
    """Return the pose in a text that was typed or copied from a controller.

    Names of coordinates and brackets are ignored, as in `{X 812.5, Y 0, Z 310, A 90, B 0, C 180}`
    or `p[0.4, 0, 0.3, 0, 3.14, 0]`. The order is the format's; decimal points are expected.

    Args:
        codec: its format, in the units of the manufacturer.

    Raises:
        ValueError: another count of numbers, or numbers that are no pose.
    """
    words = [word for word in _SEPARATORS.split(text) if re.fullmatch(NUMBER_PATTERN, word)]
    count = len(codec.columns)
    # Further numbers, such as the configuration in ABB's robtarget, come after the pose.
    if len(words) != count and not (codec.name == "abb" and len(words) > count):
        raise ValueError(
            f"pose: expected {count} numbers ({', '.join(codec.columns)}, {codec.name}), found "
            f"{len(words)} in {text[:80]!r}"
        )
    row = np.array([float(word) for word in words[:count]])
    return host_matrices(codec.decode(row[None], *codec.units, labels=["typed"]))[0]


class TypedRobot:
    """A robot whose poses are typed or pasted by a person, one for each view."""

    def __init__(self, pose_format: str):
        """Store the format; raise a ValueError if it is unknown."""
        self.codec: PoseCodec = pose_codec(pose_format)
        self._lock = threading.Lock()
        self._pose: Float[np.ndarray, "4 4"] | None = None

    def type(self, text: str) -> None:
        """Take a pose from a text; see `parse_pose`."""
        pose = parse_pose(text, self.codec)
        with self._lock:
            self._pose = pose

    def forget(self) -> None:
        """Forget the pose, so that the next view needs a new one."""
        with self._lock:
            self._pose = None

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the pose that was typed last."""
        with self._lock:
            if self._pose is None:
                names = ", ".join(self.codec.columns)
                raise SourceLostError(f"type the robot's pose: {names} ({self.codec.name})")
            return self._pose.copy()

    def close(self) -> None:
        """Do nothing; a person needs no closing."""
