"""Do one job in this process, and write what JAX did in it: programs, and seconds for each phase.

Run by `startup.py`, by its path: the package that it imports may be another revision's.
"""

import atexit
import importlib
import json
import shutil
import sys
import time
from pathlib import Path
from typing import Any

PHASES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
    "/jax/compilation_cache/cache_retrieval_time_sec": "retrieve",
    "/smartview_jax/program_read": "read",
}


class Recorder:
    """Spans of time by phase, and counts of events, since the last start."""

    def __init__(self) -> None:
        import jax

        jax.monitoring.register_event_duration_secs_listener(self._span)
        jax.monitoring.register_event_listener(self._event)
        self.start()

    def start(self) -> None:
        """Forget what was recorded so far."""
        self.spans: dict[str, list[tuple[float, float]]] = {name: [] for name in PHASES.values()}
        self.hits = 0
        self.began = time.perf_counter(), time.process_time()

    def _span(self, event: str, duration_secs: float, **_: Any) -> None:
        now = time.perf_counter()
        if event in PHASES:
            self.spans[PHASES[event]].append((now - duration_secs, now))

    def _event(self, event: str, **_: Any) -> None:
        self.hits += event == "/jax/compilation_cache/cache_hits"

    def figures(self) -> dict[str, float]:
        """Seconds without overlap: one function may be traced within another, or in a thread."""
        seconds = {name: _covered(spans) for name, spans in self.spans.items()}
        # What is read from JAX's cache is read within the span of its compilation; what the package
        # keeps by itself is not compiled at all.
        seconds["compile"] -= seconds["retrieve"]
        seconds["retrieve"] += seconds.pop("read")
        read = len(self.spans["read"])
        wall = time.perf_counter() - self.began[0]
        every = [span for spans in self.spans.values() for span in spans]
        return {
            "programs": len(self.spans["compile"]) + read,
            "hits": self.hits + read,
            **seconds,
            "run": wall - _covered(every),
            "wall": wall,
            "processor": time.process_time() - self.began[1],
        }


def _covered(spans: list[tuple[float, float]]) -> float:
    """Length of the union of spans of time."""
    total, reached = 0.0, -float("inf")
    for begin, end in sorted(spans):
        total += max(0.0, end - max(begin, reached))
        reached = max(reached, end)
    return total


def _sample(folder: Path) -> Path:
    """A copy of the package's sample, so that no detections of an earlier run are read."""
    import smartview_jax

    source = Path(smartview_jax.__file__).parent / "samples" / "rct_circle10x10"
    ignored = shutil.ignore_patterns("detections.csv")
    return Path(shutil.copytree(source, folder / "sample", ignore=ignored))


def _yardstick() -> None:
    """Compile and run a program of fixed size."""
    import jax
    import jax.numpy as jnp
    import numpy as np

    def many_operations(x: jax.Array) -> jax.Array:
        for k in range(12):
            x = jnp.tanh(x @ x.T + k) + jnp.sort(x, axis=k % 2) + jnp.linalg.inv(x + k)
        return x.sum()

    jax.jit(jax.grad(many_operations))(np.eye(6)).block_until_ready()


def main() -> None:
    job, result, folder = sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3])
    if job == "smartview --help":
        from smartview_jax.cli import app

        app(["--help"])
    if job == "import jax":
        importlib.import_module("jax")
        return
    if job == "import smartview_jax":
        importlib.import_module("smartview_jax")
        return
    if job == "import sv.calibrate":
        importlib.import_module("smartview_jax").calibrate  # noqa: B018
        return
    recorder = Recorder()
    atexit.register(lambda: result.write_text(json.dumps(recorder.figures())))
    if job == "yardstick":
        recorder.start()
        _yardstick()
    elif job == "smartview calibrate":
        from smartview_jax.cli import app

        app(["calibrate", "--out", str(folder / "calibration")])
    else:
        import smartview_jax as sv

        data = sv.load_dataset(_sample(folder))
        if job == "second fit":
            sv.calibrate(data)
            data = data.select(range(12))
            recorder.start()
        sv.calibrate(data)


if __name__ == "__main__":
    main()
