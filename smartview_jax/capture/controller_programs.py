"""Return programs for robot controllers that answer `tcp_robot`, and an example node of ROS 2."""

from pathlib import Path

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
    if name not in PROGRAMS:
        raise ValueError(f"program: expected one of {', '.join(PROGRAMS)}, found {name!r}")
    path = Path(__file__).parent / "programs" / PROGRAMS[name]
    return path.read_text(encoding="utf-8")
