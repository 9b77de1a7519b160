"""Run one benchmark by name, or all of them on small sizes.

python -m benchmarks                 # what there is
python -m benchmarks table1          # one, at full size
python -m benchmarks --smoke         # all, small: do they still run, do their claims hold
python -m benchmarks --smoke --jobs 2    # the same, each in a process of its own, two at a time
"""

import argparse
import importlib
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

BENCHMARKS = {
    "table1": "the paper's Table 1 on its simulated set-up, with the joint fit",
    "paper": "the paper's Table 1 and stylus test (Fig. 2) from rendered and detected pictures",
    "real_sets": "the joint fit on the real data sets, against their reference figures",
    "arm": "a real arm's joint zeros found together with its camera, against SciPy and in folds",
    "kinematics": "axes and gear ratios of a real positioner from measured poses",
    "held_out": "error on unseen views of the real sets, against OpenCV and vision-calibration",
    "consistency": "whether stated uncertainty is true: NEES and coverage over simulated runs",
    "budget": "where the error comes from on the real data sets, and whether the culprit is named",
    "regimes": "a map of simulated regimes: when the joint fit pays, and how near the bound it is",
    "few_views": "the default on few views against the best of simple fits, simulated and real",
    "weak_robots": "robots from exact to 20 mm of noise: the default against the best simple fit",
    "directions": "robots that err along some axes or by one joint: mounts and intervals",
    "small_arm": "a hobby arm with zeros wrong by degrees: the default, and a prior of its own",
    "target_shape": "bowed boards, a lens of higher order: mounts and intervals, against OpenCV",
    "target_size": "intervals where data hardly tell the size of the target: do they agree",
    "mistakes": "deliberate mistakes in good data sets: does `smartview check` name each of them?",
    "single_tags": "a single small tag, two poses in each view: right in how many sets?",
    "rigs": "several cameras on one arm: one fit of all against a fit for each",
    "depth": "a depth sensor with bias: hand-eye errors by closed forms and by sv.depth",
    "touches": "touches of a stylus correct a calibration: later misses, foretold and actual",
    "kinhec": "poses without pixels: KinHEC's eight tracks, with its eleven reference solvers",
    "defaults": "lenses and noises on the real data sets by held-out error",
    "engine": "the joint fit against Ceres, gtsam, casadi, SciPy: time, memory, cost",
    "gpu": "the engine on a graphics processor, if there is one, against the CPU",
    "growth": "time and memory of fits and of the whole calibration by points, views, devices",
    "viewpoints": "the calibration of new viewpoints: how many a second, and one alone",
    "choice": "chosen views against random ones: bounds in simulation, errors on a real set",
    "capture": "live capture without a person, its process killed: mm reached, nothing lost?",
    "object_features": "corners and proposed models on pictures of objects, against references",
    "modeling": "vertices of objects from clicks: NEES, edges, peers, real pictures, times",
    "grasping": "grasps executed in physics, by staged and joint calibration: held, and foretold?",
    "hypotheses": "known objects searched without a start: ranks of the right pose, seconds",
    "localization": "known objects found and judged: recall, false accepts, errors, NEES, seconds",
    "localization_wrong_rigs": "pictures of a wrong rig: named, and poses as exact as they say?",
    "asks": "what users ask most: each question with the command or call that answers it",
    "fuzz": "files with mistakes of 200 kinds: refused by name, or their values as they were",
    "mutations": "bugs put into the package on purpose: does the suite notice each of them",
    "startup": "the time to a first answer, from `smartview --help` to the whole command",
    "editor": "the time from a click in the object-model editor to the drawn answer",
    "fleet": "robots of one type: the gain from one another, sets a minute, memory",
    "stages": "every stage timed against OpenCV, in one run",
}

LONGEST_SMOKE = ("localization", "grasping", "modeling", "hypotheses", "engine")
"""The ones whose small versions take longest: begun first, so that none of them is left over."""


def main() -> int:
    listing = "\n".join(f"  {name:12} {text}" for name, text in BENCHMARKS.items())
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description=listing,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="which to run")
    parser.add_argument("--smoke", action="store_true", help="small sizes; all, unless named")
    parser.add_argument(
        "--jobs", type=int, metavar="N", help="with --smoke: in processes, N at a time"
    )
    parser.add_argument("--against", metavar="REV", help="startup: another revision in turn")
    parser.add_argument(
        "--results",
        type=Path,
        metavar="FILE",
        help="capture, localization, mutations, weak_robots: earlier records, to go on from",
    )
    arguments = parser.parse_args()
    unknown = set(arguments.names) - set(BENCHMARKS)
    if unknown:
        parser.error(f"no benchmark is called {', '.join(sorted(unknown))}; there is\n{listing}")
    if arguments.jobs and not arguments.smoke:
        parser.error("--jobs goes with --smoke: whoever measures wants the machine alone")
    names = arguments.names or (list(BENCHMARKS) if arguments.smoke else [])
    if not names:
        parser.print_help()
    if arguments.jobs:
        failed = _failed_in_processes(names, arguments.jobs)
    else:
        failed = [name for name in names if not _holds(name, arguments)]
    if failed:
        print(f"\nclaims that did not hold: {', '.join(failed)}")
    return 1 if failed else 0


def _holds(name: str, arguments: argparse.Namespace) -> bool:
    """Run a benchmark, and return whether its claims hold."""
    print(f"\n== {name}: {BENCHMARKS[name]}")
    options = {
        "startup": {"against": arguments.against},
        "capture": {"results": arguments.results},
        "localization": {"results": arguments.results},
        "mutations": {"results": arguments.results},
        "weak_robots": {"results": arguments.results},
    }
    begun = time.perf_counter()
    module = importlib.import_module(f"benchmarks.{name}")
    holds = module.run(smoke=arguments.smoke, **options.get(name, {}))
    print(f"== {name} took {time.perf_counter() - begun:.0f} s")
    return holds


def _failed_in_processes(names: list[str], jobs: int) -> list[str]:
    """Run small versions of benchmarks, so many at a time; return those whose claims fail."""

    def run(name: str) -> int:
        command = [sys.executable, "-m", "benchmarks", "--smoke", name]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        print(done.stdout, end="", flush=True)
        return done.returncode

    names = sorted(names, key=lambda name: name not in LONGEST_SMOKE)
    with ThreadPoolExecutor(jobs) as workers:
        return [name for name, code in zip(names, workers.map(run, names), strict=True) if code]


if __name__ == "__main__":
    sys.exit(main())
