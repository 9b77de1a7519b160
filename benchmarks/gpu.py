"""The engine on a graphics processor, against the CPU of the same machine.

Without a graphics processor only the CPU's figures are printed. Every fit runs in a process of its
own, on the platform that `JAX_PLATFORMS` names.
"""

import sys
import tempfile
from pathlib import Path

import jax

from .engine import measured, median, python
from .peers.problem import SIZES, make

ROUNDS = 3
MANY, MANY_SIZE = 10_000, (15, 100, False)
"""Number of small fits in one call, and the views and points of each."""

PRODUCTS = {"views of c, d": (500, 1000), "views of e": (5000, 200)}
"""Views, and points a view, for which products of small matrices are timed."""


def run(smoke: bool = False) -> bool:
    """Print the tables; True where both platforms reach the same cost."""
    platforms = _platforms()
    if len(platforms) == 1:
        print("no graphics processor at hand: figures of the CPU alone")
    print(f"{'':26}" + "".join(f"{name:>12}" for name in platforms) + "   seconds")
    sizes = {"a": (5, 100, False)} if smoke else {k: SIZES[k] for k in "abcde"}
    with tempfile.TemporaryDirectory() as folder:
        same = [_problem(Path(folder), name, size, platforms) for name, size in sizes.items()]
        same.append(_many(Path(folder), platforms, 20 if smoke else MANY))
    for name, (views, points) in PRODUCTS.items():
        _products(name, views // 10 if smoke else views, points, platforms)
    return all(same)


def _platforms() -> list[str]:
    """Return the platforms of this machine, the CPU first."""
    try:
        jax.devices("gpu")
    except RuntimeError:
        return ["cpu"]
    return ["cpu", "cuda,cpu"]


def _problem(folder: Path, name: str, size: tuple[int, int, bool], platforms: list[str]) -> bool:
    """Print the seconds of one fit; return whether its cost is the same on all platforms."""
    path = folder / f"{name}.f64"
    make(*size).save(path)
    costs = []
    for call in ("fit_joint", "solve"):
        command = python("smartview", "forward", call)(path, ROUNDS)
        found = [measured(command, platform) for platform in platforms]
        costs += [trial["cost"] for trial in found]
        _print_row(f"{name} {size[0]} x {size[1]} {call}", found)
    path.unlink()
    return max(costs) <= min(costs) * (1.0 + 1e-9)


def _many(folder: Path, platforms: list[str], count: int) -> bool:
    """Print the seconds of many small fits; return whether the first one's cost is the same."""
    path = folder / "many.f64"
    make(*MANY_SIZE).save(path)
    command = python("smartview_many", "1", str(count))(path, 1)
    found = [measured(command, platform) for platform in platforms]
    for row in found:
        row["seconds"] = [count * seconds for seconds in row["seconds"]]
    _print_row(f"{count} fits of 15 x 100", found)
    for row in found:
        row["seconds"] = [count * row["device_seconds"]]
    _print_row("  their program alone", found)
    costs = [trial["cost"] for trial in found]
    return max(costs) <= min(costs) * (1.0 + 1e-9)


def _products(name: str, views: int, points: int, platforms: list[str]) -> None:
    """Print the seconds of products of small matrices, as `einsum` and as a sum of products."""
    command = [sys.executable, "-m", "benchmarks.peers.small_products", str(views), str(points)]
    found = [measured(command, platform) for platform in platforms]
    for row in found[0]:
        _print_row(f"{name}: {row}", [{"seconds": [trial[row]]} for trial in found])


def _print_row(name: str, found: list[dict]) -> None:
    print(
        f"{name:26}" + "".join(f"{median([trial], 'seconds'):12.6f}" for trial in found), flush=True
    )
