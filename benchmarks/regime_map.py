"""The map of regimes from its runs: ratios with their intervals, the table, the picture."""

import csv
import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib import colors
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from smartview_jax.files import write_atomically

from .regime_trials import DEFAULT, KNOWN_ARM, STAGED, TRUSTED, WHITE, Regime

MEASURES = ("px", "mm", "deg")
RESAMPLES = 4000

Runs = dict[str, Any]
"""By a regime's and a seed's key: what `one_run` returned."""


class Ratio(NamedTuple):
    """Root mean square over seeds of one error over another, and its 95 % bootstrap interval.

    Of squares, because that is what the bound is a bound of: the mean of the ratios themselves is
    below one for an efficient estimator.
    """

    value: float
    lower: float
    upper: float


class Errors(NamedTuple):
    """What a method did in a regime.

    Attributes:
        by_seed: px, mm and deg in each run; NaN where it failed.
        bound: px, in each run.
    """

    by_seed: Float[np.ndarray, "seeds 3"]
    bound: Float[np.ndarray, "seeds"]

    @property
    def failures(self) -> int:
        return int(np.isnan(self.by_seed[:, 0]).sum())

    @property
    def over_bound(self) -> Ratio:
        return ratio(self.by_seed[:, 0], self.bound)

    def over(self, other: "Errors", measure: str) -> Ratio:
        """By the seeds that both of them calibrated."""
        column = MEASURES.index(measure)
        return ratio(self.by_seed[:, column], other.by_seed[:, column], pooled=True)

    def rms(self, measure: str) -> float:
        values = self.by_seed[:, MEASURES.index(measure)]
        return float(np.sqrt(np.nanmean(values**2))) if np.isfinite(values).any() else float("nan")


def ratio(
    errors: Float[np.ndarray, "seeds"], others: Float[np.ndarray, "seeds"], pooled: bool = False
) -> Ratio:
    """Of two rows of errors; pooled: the ratio of their root mean squares instead."""
    both = np.isfinite(errors) & np.isfinite(others)
    if not both.any():
        return Ratio(*3 * [float("nan")])
    above, below = (errors[both] ** 2, others[both] ** 2)
    if not pooled:
        above, below = above / below, np.ones_like(below)
    draws = np.random.default_rng(0).integers(len(above), size=(RESAMPLES, len(above)))
    found = np.sqrt(above[draws].mean(axis=1) / below[draws].mean(axis=1))
    lower, upper = np.percentile(found, [2.5, 97.5])
    return Ratio(float(np.sqrt(above.mean() / below.mean())), float(lower), float(upper))


def key(regime: Regime, seed: int) -> str:
    """A run's name: with another number anywhere in its regime it is another run."""
    return json.dumps({**vars(regime), "seed": seed}, sort_keys=True)


def load_runs(path: Path) -> Runs:
    """Finished runs, one on a line; none where there is no file."""
    if not path.is_file():
        return {}
    lines = path.read_text(encoding="utf-8").splitlines()
    return dict(json.loads(line) for line in lines)


def save_runs(path: Path, runs: Runs) -> None:
    """Write all of them, whole or not at all: an interrupted map is taken up where it stopped."""
    write_atomically(path, "".join(json.dumps(entry) + "\n" for entry in runs.items()))


def errors_of(runs: Runs, regime: Regime, seeds: Iterable[int]) -> dict[str, Errors]:
    """What every method did in a regime, over the seeds that were run."""
    done = [runs[name] for seed in seeds if (name := key(regime, seed)) in runs]
    names = dict.fromkeys(name for run in done for name in run["methods"])
    bound = np.array([run["bound"] for run in done])
    return {
        name: Errors(
            np.array(
                [[run["methods"].get(name, {}).get(m, np.nan) for m in MEASURES] for run in done]
            ),
            bound,
        )
        for name in names
    }


def table(found: Mapping[Regime, dict[str, Errors]]) -> str:
    """Rows to read: error on unseen views over the bound, and the hand-eye's, by method."""
    lines = []
    for regime, errors in found.items():
        some = next(iter(errors.values()))
        least = float(np.sqrt(np.mean(some.bound**2)))
        lines.append(
            f"{regime.axis}: {regime.name}   {len(some.bound)} seeds, bound {least:.3f} px"
        )
        for name, measured in errors.items():
            over = measured.over_bound
            failed = f"   {measured.failures} failed" if measured.failures else ""
            lines.append(
                f"  {name:24}{measured.rms('px'):8.3f} px{over.value:8.2f} x bound"
                f" ({over.lower:.2f} to {over.upper:.2f})"
                f"{measured.rms('mm'):9.3f} mm{measured.rms('deg'):8.3f} deg{failed}"
            )
    return "\n".join(lines)


def write_table(path: Path, found: Mapping[Regime, dict[str, Errors]]) -> None:
    """The same as a CSV file, with every number of the regimes."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    settings = list(vars(next(iter(found))))
    columns = "method runs failed bound_px px mm deg over_bound lower upper".split()
    writer.writerow([*settings, *columns])
    for regime, errors in found.items():
        for name, measured in errors.items():
            least = float(np.sqrt(np.mean(measured.bound**2)))
            numbers = [least, *map(measured.rms, MEASURES), *measured.over_bound]
            counts = [name.strip(), len(measured.bound), measured.failures]
            writer.writerow([*vars(regime).values(), *counts, *(f"{n:.4g}" for n in numbers)])
    write_atomically(path, text.getvalue())


def heat_map(found: Mapping[Regime, dict[str, Errors]]) -> Figure:
    """Every method over the bound, and the joint fits over the staged one: below one they pay."""
    names = list(dict.fromkeys(name for errors in found.values() for name in errors))
    joint = [name for name in (TRUSTED, WHITE, DEFAULT, KNOWN_ARM) if name in names]
    pairs = [(name, measure) for name in joint for measure in ("px", "mm")]
    over_bound = np.full((len(found), len(names)), np.nan)
    over_staged = np.full((len(found), len(pairs)), np.nan)
    for row, errors in enumerate(found.values()):
        for name, measured in errors.items():
            over_bound[row, names.index(name)] = measured.over_bound.value
        for column, (name, measure) in enumerate(pairs):
            if name in errors and STAGED in errors:
                over_staged[row, column] = errors[name].over(errors[STAGED], measure).value
    size = (6.0 + 0.75 * (len(names) + len(pairs)), 3.0 + 0.33 * len(found))
    figure = Figure(figsize=size, layout="constrained")
    left, right = figure.subplots(
        1, 2, sharey=True, gridspec_kw={"width_ratios": [len(names), len(pairs)]}
    )
    _cells(left, over_bound, [name.strip() for name in names], colors.LogNorm(1.0, 4.0), "magma_r")
    left.set_title("error on unseen views\n/ Cramér-Rao bound")
    labels = [f"{name}, {'hand-eye ' if part == 'mm' else ''}{part}" for name, part in pairs]
    _cells(right, over_staged, labels, colors.LogNorm(1.0 / 3.0, 3.0), "RdYlGn_r")
    right.set_title("error / staged error:\nthe joint fit pays where green")
    left.set_yticks(range(len(found)), [f"{regime.axis}: {regime.name}" for regime in found])
    return figure


def _cells(
    axes: Axes, values: np.ndarray, labels: list[str], scale: colors.Normalize, palette: str
) -> None:
    drawn = axes.imshow(values, norm=scale, cmap=palette, aspect="auto")
    axes.set_xticks(range(len(labels)), labels, rotation=40, ha="right", rotation_mode="anchor")
    for (row, column), value in np.ndenumerate(values):
        if np.isfinite(value):
            red, green, blue, _ = drawn.cmap(scale(value))
            dark = 0.3 * red + 0.6 * green + 0.1 * blue < 0.5
            shade = "white" if dark else "black"
            axes.text(column, row, f"{value:.2f}", ha="center", va="center", size=8, color=shade)
