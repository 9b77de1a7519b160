"""CasADi with IPOPT: symbolic derivatives, mapped over points and views, Gauss-Newton's Hessian."""

import shutil
import sys
import time
from pathlib import Path

START = time.perf_counter()

import casadi as ca  # noqa: E402  # pyright: ignore[reportMissingImports]
import numpy as np  # noqa: E402

from . import problem as peer  # noqa: E402
from .result import report, timed  # noqa: E402

UNKNOWNS = 17
"""Camera, and twice a translation and a rotation."""


def main(path: Path, repeats: int) -> None:
    """Time one fit."""
    data = peer.load(path)
    views = len(data.pixels)
    robots, pixels = data.tool_from_base.reshape(views, 12).T, data.pixels.reshape(views, -1).T
    x, p, s, g = ca.MX.sym("x", UNKNOWNS), ca.MX.sym("p", 0), ca.MX.sym("s"), ca.MX.sym("g", 0)
    cost, first, second = (
        view.map("all", "serial", views, [0], list(range(view.n_out())))
        for view in (_view(data, derivatives) for derivatives in range(3))
    )
    options = {
        "grad_f": ca.Function("nlp_grad_f", [x, p], first.call([x, robots, pixels])),
        "hess_lag": ca.Function("nlp_hess_l", [x, p, s, g], [s * second(x, robots, pixels)]),
        "ipopt": {"print_level": 0, "tol": 1e-9, "sb": "yes"},
        "print_time": False,
    }
    solver = ca.nlpsol("fit", "ipopt", {"x": x, "f": cost(x, robots, pixels)}, options)
    start = np.concatenate([data.camera, np.zeros(12)])

    found, seconds, cold = timed(lambda: solver(x0=start), repeats, START)
    report(seconds, float(found["f"]), int(solver.stats()["iter_count"]), cold)


def _view(data: peer.Problem, derivatives: int) -> ca.Function:
    """One view's cost; with its gradient; or its Hessian as Gauss and Newton have it.

    Sums over the points are by camera and pose matrix (5 + 12), and go through the chain once.
    """
    z, robot = ca.SX.sym("z", UNKNOWNS), ca.SX.sym("robot", 12)
    local = _camera_and_pose(z, robot, data)
    chain = ca.Function("chain", [z, robot], [local, ca.jacobian(local, z)])

    c, known = ca.SX.sym("c", UNKNOWNS), ca.SX.sym("known", 5)
    r = _residual(c, known)
    J = ca.jacobian(r, c)
    sums = [[0.5 * ca.sumsqr(r)], [0.5 * ca.sumsqr(r), J.T @ r], [J.T @ J]][derivatives]
    # Interpreted, this is five times as slow.
    compiled = {
        "jit": True,
        "compiler": "shell",
        "jit_options": {"flags": ["-O3", "-march=native"]},
    }
    point = ca.Function("point", [c, known], sums, compiled if shutil.which("gcc") else {})

    x, pose, seen = (
        ca.MX.sym("x", UNKNOWNS),
        ca.MX.sym("pose", 12),
        ca.MX.sym("seen", data.pixels[0].size),
    )
    at, by = chain(x, pose)
    everything = ca.vertcat(ca.DM(data.points.T), ca.reshape(seen, 2, len(data.points)))
    summed = point.map("sum", "serial", len(data.points), [0], list(range(len(sums))))
    found = summed(at, everything)
    if derivatives == 0:
        outputs = [found]
    elif derivatives == 1:
        outputs = [found[0], by.T @ found[1]]
    else:
        outputs = [ca.triu(by.T @ found @ by)]
    return ca.Function("view", [x, pose, seen], outputs)


def _residual(c: ca.SX, known: ca.SX) -> ca.SX:
    pose = ca.reshape(c[5:], 3, 4)
    p = pose[:, :3] @ known[:3] + pose[:, 3]
    x, y = p[0] / p[2], p[1] / p[2]
    ratio = 1.0 + c[4] * (x * x + y * y)
    pixel = ca.vertcat(c[0] * x * ratio + c[2], c[1] * y * ratio + c[3])
    return (known[3:] - pixel) / peer.PIXEL


def _camera_and_pose(z: ca.SX, robot: ca.SX, data: peer.Problem) -> ca.SX:
    """Camera and camera_from_world, by columns."""
    turn, shift = ca.SX.eye(3), ca.SX.zeros(3)
    hand, world = _moved(data.camera_from_tool, z[5:11]), _moved(data.base_from_world, z[11:])
    for pose in (world, ca.reshape(robot, 4, 3).T, hand):
        turn, shift = pose[:, :3] @ turn, pose[:, :3] @ shift + pose[:, 3]
    return ca.vertcat(z[:5], ca.vec(turn), shift)


def _moved(start: np.ndarray, step: ca.SX) -> ca.SX:
    """The rotation by Cayley's map, which has no root to differentiate at zero."""
    K = ca.skew(0.5 * step[3:])
    turn = ca.SX.eye(3) + 2.0 / (1.0 + 0.25 * ca.sumsqr(step[3:])) * (K + K @ K)
    return ca.horzcat(turn @ start[:, :3], step[:3] + start[:, 3])


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]))
