"""When does the joint fit pay, and how near is each estimator to the Cramér-Rao bound?

A study over simulated regimes: noise of pixels, noise of the robot, number of views, points in a
view, spread of the viewpoints, and a 6R arm with errors in its joints, links and twists. The table
and one picture are written to a folder, with the runs themselves: a map that was interrupted is
taken up where it stopped, and more seeds add to it. Runs are kept by the regime's numbers, not by
the library's version: begin in another folder after changing the library.

    python -m benchmarks regimes                              # all, into ./regimes
    python -m benchmarks.regimes --out map --only arm --seeds 4
"""

import argparse
import itertools
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import jax

from .regime_map import (
    Errors,
    errors_of,
    heat_map,
    key,
    load_runs,
    save_runs,
    table,
    write_table,
)
from .regime_trials import DEFAULT, KNOWN_ARM, PARK, STAGED, TRUSTED, Regime, methods, one_run

ARM_NOISE = {"grid": (9, 12), "pixel": 0.05, "translation": 0.02, "rotation": 0.003, "tilt": 30.0}

JUDGED_ARM = Regime("6R arm", "usual errors, 25 views", 25, errors=1.0, seeds=20, **ARM_NOISE)
ARM_REGIMES = (
    JUDGED_ARM,
    Regime("6R arm", "a third of them", 25, errors=1.0 / 3.0, **ARM_NOISE),
    Regime("6R arm", "three times them", 25, errors=3.0, **ARM_NOISE),
    Regime("6R arm", "15 views", 15, errors=1.0, **ARM_NOISE),
    Regime("6R arm", "8 views", 8, errors=1.0, **ARM_NOISE),
)

SEEDS = {5: 40, 25: 24}
"""Runs by views, where fits are so close or scatter so much that eight would leave it to chance."""

LITTLE, MUCH = (0.01, 0.001), (0.3, 0.05)
"""Noise of a robot, mm and degrees, where the usual noise is 0.1 and 0.01."""

WHITE_REGIMES = (
    Regime("white noise", "15 views, 90 points, 0.15 px, 0.1 mm, 0.01 deg, 35 deg"),
    Regime("pixels", "0.05 px", pixel=0.05),
    Regime("pixels", "0.5 px", pixel=0.5),
    Regime("points", "42", grid=(6, 7)),
    Regime("points", "12", grid=(3, 4)),
    Regime("spread", "20 deg", tilt=20.0),
    Regime("spread", "10 deg", tilt=10.0),
    Regime("robot", "0.1 mm, 0.05 deg", rotation=0.05),
    Regime("robot", "1 mm, 0.1 deg", translation=1.0, rotation=0.1),
    *(
        Regime(
            "views, robot",
            f"{views}, {mm:g} mm, {deg:g} deg",
            views,
            translation=mm,
            rotation=deg,
            seeds=SEEDS.get(views, 8),
        )
        for (mm, deg), views in itertools.product((LITTLE, (0.1, 0.01), MUCH), (5, 8, 15, 25))
        if (views, mm) != (15, 0.1)
    ),
    Regime("few", "10 views, 12 points, little", 10, (3, 4), 0.15, *LITTLE),
    Regime("few", "10 views, 12 points, 0.05 deg", 10, (3, 4), 0.15, 0.1, 0.05),
)
SMOKE = Regime("smoke", "8 views, 12 points", 8, (3, 4), seeds=2)
SMOKE_METHODS = (STAGED, TRUSTED, PARK)
"""Those that compile in seconds."""

NEAR_BOUND, FEW_VIEWS, NEAR_BOUND_OF_FEW = 1.05, 8, 1.15
"""Times the bound at most, by the interval's lower end; below so many views the last."""

BEST = 1.03
"""Times the better of the staged and of the plain joint fit, at most."""

OF_STAGED = {"px": 0.55, "mm": 0.6}
"""Of the staged fit's error, at most, where the arm errs: on unseen views, and of the hand-eye."""


def run(smoke: bool = False) -> bool:
    """Print the map and write it; True where every claim about the default holds."""
    if not smoke:
        return study(Path("regimes"), (*ARM_REGIMES, *WHITE_REGIMES))
    with tempfile.TemporaryDirectory() as folder:
        return study(Path(folder), (SMOKE,), names=SMOKE_METHODS, judged=False)


def study(
    folder: Path,
    regimes: Sequence[Regime],
    seeds: int | None = None,
    names: Sequence[str] | None = None,
    judged: bool = True,
) -> bool:
    """Run what is missing, one regime after the other; then table, picture and verdicts."""
    path = folder / "runs.jsonl"
    runs, errors_in = load_runs(path), {}
    arm_before = None
    for number, regime in enumerate(regimes):
        if arm_before not in (None, regime.errors is not None):
            # The programs of the other kind would stay in a process's memory maps for nothing.
            jax.clear_caches()
        arm_before = regime.errors is not None
        count = range(regime.seeds if seeds is None else seeds)
        wanted = [name for name in methods(regime) if names is None or name in names]
        for seed in count:
            run = runs.setdefault(key(regime, seed), {"methods": {}})
            missing = set(wanted) - set(run["methods"])
            if not missing:
                continue
            _say(f"{number + 1} of {len(regimes)}, {regime.axis}: {regime.name}, seed {seed}")
            new = one_run(regime, seed, missing)
            runs[key(regime, seed)] = {**new, "methods": {**run["methods"], **new["methods"]}}
            save_runs(path, runs)
        _say("")
        errors_in[regime] = errors_of(runs, regime, count)
        print(table({regime: errors_in[regime]}), flush=True)
    write_table(folder / "table.csv", errors_in)
    heat_map(errors_in).savefig(folder / "map.png", dpi=120)
    print(f"written: {folder / 'table.csv'}, {folder / 'map.png'}")
    return all(list(_verdicts(errors_in))) if judged else _all_ran(errors_in)


def _say(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def _all_ran(found: Mapping[Regime, dict[str, Errors]]) -> bool:
    return all(method.failures == 0 for errors in found.values() for method in errors.values())


def _verdicts(found: Mapping[Regime, dict[str, Errors]]) -> Iterable[bool]:
    """Each claim by itself, printed where it does not hold, and how many do."""
    claims: dict[str, list[bool]] = {}
    for regime, errors in found.items():
        for claim, value, most in _claims(regime, errors):
            held = value <= most
            claims.setdefault(claim, []).append(held)
            if not held or regime.errors is not None:
                word = "holds" if held else "DOES NOT HOLD"
                print(f"{regime.axis}: {regime.name}: {claim} {value:.3f} <= {most}: {word}")
    for claim, held in claims.items():
        print(f"{claim}: holds in {sum(held)} of {len(held)} regimes")
        yield all(held)


def _claims(regime: Regime, errors: dict[str, Errors]) -> Iterable[tuple[str, float, float]]:
    """What is claimed of the default, by how much it is, and may be."""
    default, staged, trusted = (errors[name] for name in (DEFAULT, STAGED, TRUSTED))
    if regime.errors is None:
        most = NEAR_BOUND_OF_FEW if regime.views < FEW_VIEWS else NEAR_BOUND
        yield "default over the bound, lower end,", default.over_bound.lower, most
        better = max(default.over(other, "px").value for other in (staged, trusted))
        yield "default over the better of staged and trusted", better, BEST
    elif regime == JUDGED_ARM and len(default.bound) >= JUDGED_ARM.seeds:
        for name, measure in itertools.product((DEFAULT, KNOWN_ARM), OF_STAGED):
            if name in errors:
                value = errors[name].over(staged, measure).value
                yield f"{name} over staged, {measure},", value, OF_STAGED[measure]


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.regimes")
    parser.add_argument("--out", type=Path, default=Path("regimes"), help="folder of the results")
    parser.add_argument("--only", default="", help="regimes whose axis or name has these words")
    parser.add_argument("--seeds", type=int, help="runs of every regime")
    parser.add_argument("--methods", help="names between semicolons, instead of all of them")
    chosen = parser.parse_args()
    regimes = [r for r in (*ARM_REGIMES, *WHITE_REGIMES) if chosen.only in f"{r.axis}: {r.name}"]
    if not regimes:
        parser.error(f"no regime has {chosen.only!r} in its name")
    known = list(methods(JUDGED_ARM))
    names = None if chosen.methods is None else chosen.methods.split(";")
    if not set(names or known) <= set(known):
        parser.error(f"methods are {'; '.join(known)}; found {chosen.methods!r}")
    judged = names is None or {DEFAULT, STAGED, TRUSTED} <= set(names)
    return 0 if study(chosen.out, regimes, chosen.seeds, names, judged) else 1


if __name__ == "__main__":
    sys.exit(main())
