"""mrcal's solve for one camera and free poses: Step 2's job, on a board of equal squares."""

import sys
import time

START = time.perf_counter()

import mrcal  # noqa: E402  # pyright: ignore[reportMissingImports]
import numpy as np  # noqa: E402

from .result import report, timed  # noqa: E402


def main(path: str, repeats: int) -> None:
    """Time one fit; its cost is the RMS in pixels."""
    data = np.load(path)
    views = len(data["poses"])
    indices = np.array([(k, 0, -1) for k in range(views)], dtype=np.int32)

    def fit():
        board = data["board"].copy()
        stats = mrcal.optimize(
            # No distortion at the start: the numbers of its lens are in OpenCV's direction.
            np.concatenate([data["camera"], np.zeros(4)])[None],
            None,
            data["poses"].copy(),
            None,
            board,
            indices,
            None,
            None,
            lensmodel="LENSMODEL_OPENCV4",
            imagersizes=data["image_size"].astype(np.int32)[None],
            calibration_object_spacing=float(data["spacing"]),
            do_optimize_calobject_warp=False,
            do_apply_outlier_rejection=False,
            do_apply_regularization=False,
        )
        return np.sqrt(np.sum(stats["x"] ** 2) / np.sum(board[..., 2] > 0))

    rms, seconds, cold = timed(fit, repeats, START)
    report(seconds, float(rms), float("nan"), cold)


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
