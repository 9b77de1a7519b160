"""What a user is told who gives something of the wrong kind.

In a process of its own: in these tests a checker of types would be first.
"""

import json
import subprocess
import sys

import pytest

from smartview_jax.argument_checks import (
    errors_at,
    name_problem,
    nearest_name,
    require_instance,
    require_names,
    require_one_of,
    require_readable,
    require_readable_or_empty,
)

CASES = {
    "fit(priors={'camera.u0': 3.0})": "priors['camera.u0']: expected Prior, found 3.0 (float)",
    "fit(priors={'camera.u0': (3.0, 1.0)})": "a Prior has a mean and a std",
    "fit(solver='lm')": "solver: expected AbstractLeastSquaresSolver, found 'lm' (str); such as",
    "fit(fixed='camera')": "fixed: expected a list of names such as ['camera'], found 'camera'",
    "fit(free='target_scale')": "free: expected a list of names such as ['target_scale']",
    "sv.calibrate(np.zeros((20, 20)))": "data: expected Dataset, found one of type ndarray",
    "sv.calibrate(data, camera=np.eye(3))": "camera: expected Camera, found",
    "sv.fit_joint(calibration, data)": "data: expected Dataset, found",
    "sv.fit_joint(data, calibration.camera)": "start: expected Calibration, found",
    "sv.fit_poses(5)": "samples: expected TrackedPoses, found 5 (int); a PoseDataset, or the Pose",
    "sv.next_view([], views, None)": "found one of type RigViews; of a rig, give the camera that t",
    "sv.GraspScene(views)": "expected Calibration, found one of type RigViews; of a rig, give a ca",
}

SCRIPT = """
import json, sys
import numpy as np
import smartview_jax as sv
from smartview_jax.simulation import paper_calibration, paper_points

# Arguments are looked at before the data are: nothing is computed.
calibration, points = paper_calibration(), paper_points((0.0,))
poses = np.tile(np.eye(4), (5, 1, 1))
data = sv.Dataset.from_arrays(points, np.full((5, len(points), 2), 9.0), poses, (640, 480))

views = sv.RigViews({"left": calibration}, ["left"])

def fit(**options):
    return sv.fit_joint(data, calibration, noise="trusted", **options)

said = {}
for case in json.loads(sys.argv[1]):
    try:
        eval(case)
    except (TypeError, ValueError) as error:
        said[case] = str(error)
print(json.dumps(said))
"""


@pytest.fixture(scope="module")
def said():
    words = [sys.executable, "-c", SCRIPT, json.dumps(list(CASES))]
    run = subprocess.run(words, capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.parametrize("case", CASES)
def test_a_wrong_argument_is_named(said, case):
    assert CASES[case] in said[case]


def test_what_is_right_passes():
    require_instance("data", [1], list)
    require_names("fixed", ("camera",))


def test_long_values_are_not_printed():
    with pytest.raises(TypeError, match=r"^data: expected dict, found one of type list$"):
        require_instance("data", list(range(100)), dict)


@pytest.mark.parametrize(
    "odd",
    [
        *("", "a\tb", "a\xa0b", "x" * 201, "#c", "../../y", "a\nb", " a", "a ", "..\\y"),
        *("/y", "C:y", "a//b", "日" * 80),
    ],
)
def test_names_that_no_file_reads_back_are_refused(odd):
    with pytest.raises(ValueError, match=r"^views: .* is no name: "):
        require_readable("views", ["v1", odd])


def test_names_that_files_read_back_are_accepted():
    require_readable("views", ["v1", "left/0001", "a, b", "it's", '"q"', "<!--<script>", "x" * 200])
    require_readable_or_empty("face", "")


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ("v1", "v1"),
        (" top ", "top"),
        ("# 1", "1"),
        ("../../y", "y"),
        ("a\xa0b", "a b"),
        ("C:\\y", "C-/y"),
        (" a: b", "a- b"),
        (" ab: c", "ab: c"),
        ("..", ""),
        ("#", ""),
        ("\ud800", ""),
        ("\U0001f600" * 100, "\U0001f600" * 59),
        ("x" * 199 + " y", "x" * 199),
    ],
)
def test_the_nearest_name_is_one(text, name):
    assert nearest_name(text) == name
    assert not name or name_problem(name) is None


def test_what_is_no_text_is_no_name():
    with pytest.raises(ValueError, match=r"^face: 7 is no name: a name is a text, not 7 \(int\)$"):
        require_readable_or_empty("face", 7)


def test_a_choice_that_is_none_names_the_nearest():
    require_one_of("lens", "radial", ("pinhole", "radial"))
    for value, found in (("radail", r"'radail'; did you mean 'radial'\?$"), (7, "7$")):
        with pytest.raises(
            ValueError, match=f"lens is one of pinhole, radial, or 1; found {found}"
        ):
            require_one_of("lens", value, ("pinhole", "radial"), ", or 1")


def test_an_error_names_the_place_where_it_was_raised(tmp_path):
    file = tmp_path / "poses.csv"
    with pytest.raises(ValueError, match=r"poses\.csv: too few rows$") as raised, errors_at(file):
        raise ValueError("too few rows")
    assert str(raised.value).startswith(str(tmp_path))
    assert str(raised.value.__cause__) == "too few rows"
    # Other errors are not the file's.
    with pytest.raises(KeyError, match=r"^'x'$"), errors_at(file):
        {}["x"]
