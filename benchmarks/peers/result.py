"""What every peer prints: one line of JSON."""

import json
import resource


def report(seconds: list[float], cost: float, iterations: int, cold: float) -> None:
    """Seconds of each repeat, final cost, iterations, and the first answer from process start."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(
        json.dumps(
            {
                "seconds": seconds,
                "cost": cost,
                "iterations": iterations,
                "cold": cold,
                "peak_mb": peak,
            }
        )
    )
