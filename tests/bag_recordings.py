"""A robot that stops at some poses, takes pictures all the time, and publishes all in tf."""

import numpy as np
from written_bags import camera_info, picture, tf

from smartview_jax.geometry import host_exponentials

STOP, MOVE, RATE, PICTURES = 1.0, 0.5, 50, 5
"""Seconds of a stop and of a motion, poses and pictures per second."""

LATE = 0.08
"""How much later than tf a picture is recorded, s."""

SHOULDER = host_exponentials(np.array([0.1, 0.2, 0.5, 0.3, 0.1, -0.4]))
FLANGE = host_exponentials(np.array([0.0, 0.02, 0.1, 0.0, 0.0, 0.7]))
"""Static transforms at both ends of the chain."""


def stop_poses(count, seed=0):
    """Poses of the moving link."""
    rng = np.random.default_rng(seed)
    scale = [0.2, 0.2, 0.2, 0.3, 0.3, 0.3]
    return host_exponentials(rng.uniform(-1.0, 1.0, (count, 6)) * scale)


def between(first, last, fraction):
    """The pose at a fraction of a straight motion at constant speed, as tf2 interpolates."""
    turn = np.linalg.inv(first) @ last
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(turn[:3, :3]).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = first[:3, :3] @ Rotation.from_rotvec(fraction * rotation).as_matrix()
    pose[:3, 3] = (1.0 - fraction) * first[:3, 3] + fraction * last[:3, 3]
    return pose


def moving_pose(poses, seconds):
    """The pose of the moving link at a time: a stop at each pose, then a straight motion."""
    number, within = divmod(seconds, STOP + MOVE)
    number = min(int(number), len(poses) - 1)
    following = poses[min(number + 1, len(poses) - 1)]
    return between(poses[number], following, max(0.0, within - STOP) / MOVE)


def duration(poses):
    return len(poses) * (STOP + MOVE)


def tool_pose(poses, seconds):
    """`base_from_tool` of the chain: shoulder, moving link, flange."""
    return SHOULDER @ moving_pose(poses, seconds) @ FLANGE


def robot_motion(poses):
    """The messages of tf."""
    times = np.arange(0.0, duration(poses), 1.0 / RATE)
    moving = [tf(t, "shoulder", "/flange", moving_pose(poses, t)) for t in times.tolist()]
    return [
        tf(0.0, "base", "shoulder", SHOULDER, static=True),
        tf(0.0, "/flange", "tool0", FLANGE, static=True),
        *moving,
    ]


def picture_times(poses):
    return np.arange(0.5 / PICTURES, duration(poses), 1.0 / PICTURES).tolist()


def numbered_picture(seconds):
    """A picture that tells when it was taken."""
    rows, columns = np.mgrid[:12, :16]
    return ((rows * 16 + columns + round(10.0 * seconds)) % 256).astype(np.uint8)


def recording(poses, shown=numbered_picture, topic="/camera/image_raw"):
    """Motion, pictures and a known camera."""
    pictures = [picture(topic, t, shown(t), late=LATE) for t in picture_times(poses)]
    rows, columns = shown(0.0).shape[:2]
    K = [[20.0, 0.0, 8.0], [0.0, 21.0, 6.0], [0.0, 0.0, 1.0]]
    info = camera_info("/camera/camera_info", 0.0, (columns, rows), K, [0.1, -0.2, 0.0, 0.001, 0.0])
    return [*robot_motion(poses), *pictures, info]
