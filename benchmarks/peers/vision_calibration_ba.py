"""vision-calibration's whole pipeline: its own start, then its joint adjustment.

Its lens is OpenCV's with four numbers, so it ends at another cost.
"""

# The wheel fills its names in at run time.
# pyright: reportAttributeAccessIssue=false

import sys
import time
from pathlib import Path

START = time.perf_counter()

import numpy as np  # noqa: E402
import vision_calibration as vc  # noqa: E402  # pyright: ignore[reportMissingImports]

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402


def main(path: Path, repeats: int) -> None:
    """Time one fit."""
    data = peer.load(path)
    points = data.points.tolist()
    views = [
        vc.SingleCamHandeyeView(vc.Observation(points, pixels.tolist()), _pose(peer.inverse(robot)))
        for pixels, robot in zip(data.pixels, data.tool_from_base, strict=True)
    ]
    dataset = vc.SingleCamHandeyeDataset(views)
    config = vc.SingleCamHandeyeCalibrationConfig(
        robot_poses=vc.RobotPoseConfig(data.corrected, peer.ROTATION, peer.TRANSLATION)
    )
    _, seconds, cold = timed(lambda: vc.run_single_cam_handeye(dataset, config), repeats, START)
    report(seconds, None, float("nan"), cold)


def _pose(matrix: np.ndarray) -> vc.Pose:
    return vc.Pose(_quaternion(matrix[:, :3]), tuple(matrix[:, 3]))


def _quaternion(turn: np.ndarray) -> tuple[float, ...]:
    """x, y, z, w: the eigenvector of the largest eigenvalue of Bar-Itzhack's matrix."""
    skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    square = turn + turn.T - np.trace(turn) * np.eye(3)
    whole = np.block([[square, skew[:, None]], [skew[None], np.trace(turn)]])
    return tuple(np.linalg.eigh(whole)[1][:, -1])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
