"""Run one benchmark by name, or all of them on small sizes.

python -m benchmarks                 # what there is
python -m benchmarks table1          # one, at full size
python -m benchmarks --smoke         # all, small: do they still run, do their claims hold
"""

import argparse
import importlib
import sys
from pathlib import Path

BENCHMARKS = {
    "table1": "the paper's Table 1 on its simulated set-up, with the joint fit beside it",
    "paper": "the paper's Table 1 and stylus test (Fig. 2) from rendered and detected pictures",
    "real_sets": "the joint fit on the real data sets, against their reference figures",
    "arm": "a real arm's joint zeros found together with its camera, against SciPy and in folds",
    "kinematics": "axes and gear ratios of a real positioner from measured poses",
    "held_out": "error on unseen views of the real data sets, beside OpenCV and vision-calibration",
    "consistency": "whether stated uncertainty is true: NEES and coverage over simulated runs",
    "budget": "where the error comes from on the real data sets, and whether the culprit is named",
    "regimes": "a map of simulated regimes: when the joint fit pays, and how near the bound it is",
    "few_views": "the default on few views beside the best of simple fits, simulated and real",
    "defaults": "lenses and noises on the real data sets by held-out error",
    "engine": "the joint fit beside Ceres, gtsam, casadi, SciPy: time, memory, cost",
    "growth": "time and memory of the joint fit by points, views and devices",
    "viewpoints": "the calibration of new viewpoints: how many a second, and one alone",
    "choice": "chosen views against random ones: bounds in simulation, errors on a real set",
    "object_features": "corners and proposed models on pictures of objects, against references",
    "modeling": "vertices of objects from clicks: NEES, edges, peers, real pictures, times",
    "grasping": "grasps executed in physics, by staged and joint calibration: held, and foretold?",
    "hypotheses": "known objects searched without a start: ranks of the right pose, seconds",
    "localization": "known objects found and judged: recall, false accepts, errors, NEES, seconds",
    "asks": "what users ask most: each question with the command or call that answers it",
    "fuzz": "malformed files: refused by name, or their values in range",
    "startup": "the time to a first answer, from `smartview --help` to the whole command",
    "editor": "the time from a click in the object-model editor to the drawn answer",
    "stages": "every stage timed beside OpenCV, in one run",
}


def main() -> int:
    listing = "\n".join(f"  {name:12} {text}" for name, text in BENCHMARKS.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=listing,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="which to run")
    parser.add_argument("--smoke", action="store_true", help="small sizes; all, unless named")
    parser.add_argument("--beside", metavar="REV", help="startup: another revision in turn")
    parser.add_argument(
        "--results", type=Path, metavar="FILE", help="localization: its records, to go on from"
    )
    arguments = parser.parse_args()
    unknown = set(arguments.names) - set(BENCHMARKS)
    if unknown:
        parser.error(f"no benchmark is called {', '.join(sorted(unknown))}; there is\n{listing}")
    names = arguments.names or (list(BENCHMARKS) if arguments.smoke else [])
    if not names:
        parser.print_help()
    failed = []
    for name in names:
        print(f"\n== {name}: {BENCHMARKS[name]}")
        module = importlib.import_module(f"benchmarks.{name}")
        own = {"startup": {"beside": arguments.beside}}
        own["localization"] = {"results": arguments.results}
        options = own.get(name, {})
        if not module.run(smoke=arguments.smoke, **options):
            failed.append(name)
    if failed:
        print(f"\nclaims that did not hold: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
