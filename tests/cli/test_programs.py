"""A command that only multiplies matrices compiles nothing for it."""

import pytest
from board_scene import run
from programs import programs_added

from smartview_jax.simulation import paper_calibration


@pytest.mark.parametrize(
    "words",
    [
        "viewpoint {} --above --tilt 12",
        "stylus {} --above --tip 0,0.01,0.15 --at 0.02,0,0",
        "grasp {} --grasp-pose 0,0,0.013,0,180,0",
    ],
)
def test_a_command_has_one_program_for_its_checks_and_no_other(tmp_path, words):
    path = tmp_path / "calibration.yaml"
    paper_calibration().save(path)
    with programs_added() as programs:
        ended = run(*words.format(path).split())
    assert ended.exit_code == 0, ended.output
    assert len(programs) <= 1
