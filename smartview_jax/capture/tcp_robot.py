"""Talk to any controller by lines of text over TCP; `programs/` has short programs that answer.

The controller's program listens, takes one connection and answers every line with one line:

    pose                          ->  pose 812.5 -20.1 310.7 90.02 -0.01 179.98
    step 812.5 -20.1 320.7 90.02 -0.01 179.98 100
                                  ->  done           (after the motion), or: error WHY

The numbers have the controller's own pose format and units; the last number of
`step` is the speed in mm/s. A step is a short straight motion (`motion.STEP_LENGTH`): a longer one
is sent as many, each only after the one before it is done. A robot whose connection is lost,
or that is stopped, stands after at most one step.
"""

import socket
import threading
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..argument_checks import require_one_of
from ..geometry import PoseCodec, host_matrices, host_transforms, pose_codec
from .motion import refuse_if_stopped, straight_steps
from .sources import MoveRefusedError, SourceLostError

PROGRAMS = {
    "krl": "kuka.src",
    "rapid": "abb.mod",
    "urscript": "universal_robots.script",
    "val3": "staubli.pgx",
    "ros2": "ros2_node.py.txt",
}
"""The file of each program in the folder `programs`; the node is a text, as its modules are the
user's."""


def controller_program(name: str) -> str:
    """Return the text of a program.

    Args:
        name: one of `PROGRAMS`.

    Raises:
        ValueError: an unknown name.
    """
    require_one_of("program", name, PROGRAMS)
    path = Path(__file__).parent / "programs" / PROGRAMS[name]
    return path.read_text(encoding="utf-8")


TIMEOUT = 3.0
"""Longest time for the answer to `pose`, s."""

STEP_TIMEOUT = 20.0
"""Longest time for a step, s: a slow robot, or one that waits for a person to press a key."""

MAX_LINE = 1000
"""Largest length of an answer, bytes; more is no answer of such a program."""


class TcpRobot:
    """A robot whose controller runs a program that answers lines of text."""

    def __init__(self, connection: socket.socket, name: str, codec: PoseCodec):
        """Use a connection; `connect` and `accept` make one."""
        self._socket, self._name, self._codec = connection, name, codec
        self._buffer = b""
        # A line is short and waits for its answer.
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    @classmethod
    def connect(cls, host: str, port: int, pose_format: str) -> "TcpRobot":
        """Connect to a controller that listens.

        Args:
            host: name or address of the controller.
            pose_format: format of its poses, one of `geometry.POSE_CODECS`.

        Raises:
            ValueError: no such pose format.
            SourceLostError: nobody listens at the address.
        """
        codec, name = pose_codec(pose_format), f"{host}:{port}"
        try:
            return cls(socket.create_connection((host, port), TIMEOUT), name, codec)
        except OSError as error:
            raise SourceLostError(f"{name} does not answer: {error}") from error

    @classmethod
    def accept(cls, host: str, port: int, pose_format: str) -> "TcpRobot":
        """Wait for a controller that connects to this machine.

        Args:
            host: address of this machine in the controller's network.
            port: port to listen on.
            pose_format: format of the controller's poses, one of `geometry.POSE_CODECS`.

        Raises:
            ValueError: no such pose format.
            SourceLostError: the port is taken, or no controller connects within some time.
        """
        codec = pose_codec(pose_format)
        try:
            with socket.create_server((host, port), backlog=1) as listener:
                listener.settimeout(TIMEOUT)
                connection, (controller, *_) = listener.accept()
            return cls(connection, controller, codec)
        except TimeoutError as error:
            raise SourceLostError(f"no controller has connected to {host}:{port}") from error
        except OSError as error:
            raise SourceLostError(f"{host}:{port}: {error}") from error

    def pose(self) -> Float[np.ndarray, "4 4"]:
        """Return the reported pose."""
        word, *numbers = self._ask("pose", TIMEOUT).split()
        row = _numbers(numbers)
        if word != "pose" or row is None or len(row) != len(self._codec.columns):
            raise SourceLostError(
                f"{self._name}: expected 'pose' and {len(self._codec.columns)} numbers "
                f"({', '.join(self._codec.columns)}), found {' '.join((word, *numbers))[:80]!r}"
            )
        try:
            return host_matrices(self._codec.decode(row[None], *self._codec.units))[0]
        except ValueError as error:
            raise SourceLostError(f"{self._name}: {error}") from error

    def move(
        self, base_from_tool: Float[np.ndarray, "4 4"], speed: float, stop: threading.Event
    ) -> None:
        """Move step by step."""
        for pose in straight_steps(self.pose(), base_from_tool):
            refuse_if_stopped(stop)
            row = self._codec.encode(host_transforms(pose), *self._codec.units)
            numbers = " ".join(f"{number:.6f}" for number in row)
            answer = self._ask(f"step {numbers} {1e3 * speed:.3f}", STEP_TIMEOUT)
            if answer != "done":
                raise MoveRefusedError(f"{self._name}: {answer}")

    def _ask(self, line: str, timeout: float) -> str:
        """Send a line and return the answer."""
        try:
            self._socket.settimeout(timeout)
            self._socket.sendall(line.encode("ascii") + b"\n")
            while b"\n" not in self._buffer:
                received = self._socket.recv(MAX_LINE)
                if not received:
                    raise SourceLostError(f"{self._name} has closed the connection")
                self._buffer += received
                if len(self._buffer) > MAX_LINE:
                    raise SourceLostError(f"{self._name} answers without a line end")
        # After a timeout the answer may still come: it must not be taken for the next one's.
        except OSError as error:
            self.close()
            if isinstance(error, SourceLostError):
                raise
            raise SourceLostError(f"{self._name} does not answer: {error}") from error
        answer, _, self._buffer = self._buffer.partition(b"\n")
        return answer.decode("ascii", errors="replace").strip() or "error an empty answer"

    def close(self) -> None:
        """Close the connection."""
        self._socket.close()


def _numbers(words: list[str]) -> Float[np.ndarray, "numbers"] | None:
    """Return words as numbers; None if one is not."""
    try:
        return np.array([float(word) for word in words])
    except ValueError:
        return None
