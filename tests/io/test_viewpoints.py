import json

import jax.numpy as jnp
import numpy as np
import pytest
from jaxlie import SE3

from smartview_jax import se3_from_xyzoat
from smartview_jax.geometry import POSE_CODECS, five_viewpoints, look_at
from smartview_jax.io import HandSteps, read_viewpoints, val_program, write_viewpoints
from smartview_jax.simulation import paper_calibration

POSES = paper_calibration().command_for(
    five_viewpoints(np.zeros(3), 0.2, roll=np.linspace(-1.0, 2.0, 5))
)
JOINTS = np.random.default_rng(0).normal(size=(5, 6))


@pytest.mark.parametrize("ending", ["csv", "json"])
@pytest.mark.parametrize("joints", [None, JOINTS])
def test_files_are_read_back_as_they_were_written(tmp_path, ending, joints):
    path = tmp_path / f"views.{ending}"
    names = ("above", "x1", "x2", "y1", "y2")
    write_viewpoints(path, POSES, names, joints)
    loaded = read_viewpoints(path)
    assert loaded.names == names
    np.testing.assert_allclose(
        loaded.base_from_tool.as_matrix(), POSES.as_matrix(), atol=1e-12, rtol=0.0
    )
    if joints is None:
        assert loaded.joints is None
    else:
        np.testing.assert_array_equal(loaded.joints, joints)


@pytest.mark.parametrize("ending", ["csv", "json"])
@pytest.mark.parametrize("pose_format", POSE_CODECS)
def test_every_makers_poses_are_written_and_read_back(tmp_path, ending, pose_format):
    path = tmp_path / f"views.{ending}"
    write_viewpoints(path, POSES, joints=JOINTS, pose_format=pose_format)
    loaded = read_viewpoints(path)
    np.testing.assert_allclose(loaded.base_from_tool.as_matrix(), POSES.as_matrix(), atol=1e-12)
    np.testing.assert_array_equal(loaded.joints, JOINTS)


def test_a_makers_format_stands_in_the_file(tmp_path):
    write_viewpoints(tmp_path / "v.csv", POSES, pose_format="ur")
    header, first = (tmp_path / "v.csv").read_text().splitlines()[:2]
    assert header == "view,format,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad"
    assert first.startswith("v1,ur,")
    write_viewpoints(tmp_path / "v.json", POSES, pose_format="abb")
    content = json.loads((tmp_path / "v.json").read_text())
    assert (content["format"], content["units"]["length"]) == ("abb", "mm")
    assert content["columns"] == ["x", "y", "z", "q1", "q2", "q3", "q4"]
    with pytest.raises(ValueError, match="pose format is one of"):
        write_viewpoints(tmp_path / "w.csv", POSES, pose_format="kuka")
    with pytest.raises(ValueError, match="a VAL program has val_oat poses, not ur"):
        write_viewpoints(tmp_path / "w.val", POSES, pose_format="ur")
    mixed = (tmp_path / "v.csv").read_text().replace("v2,ur,", "v2,abb,")
    (tmp_path / "v.csv").write_text(mixed)
    with pytest.raises(ValueError, match=r"v\.csv: format: expected one for all views"):
        read_viewpoints(tmp_path / "v.csv")


def test_units_and_version_stand_in_the_files(tmp_path):
    write_viewpoints(tmp_path / "v.csv", POSES)
    header, first = (tmp_path / "v.csv").read_text().splitlines()[:2]
    assert header == "view,format,x_mm,y_mm,z_mm,o_deg,a_deg,t_deg"
    assert float(first.split(",")[2]) == pytest.approx(1e3 * float(POSES.translation()[0, 0]))
    write_viewpoints(tmp_path / "v.json", POSES)
    content = json.loads((tmp_path / "v.json").read_text())
    assert content["smartview_viewpoints"] == 1
    assert content["units"]["length"] == "mm"
    content["smartview_viewpoints"] = 7
    (tmp_path / "v.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match="expected 1, found 7"):
        read_viewpoints(tmp_path / "v.json")


def test_one_viewpoint_needs_no_row_of_them(tmp_path):
    pose = look_at((0.1, 0.2, 0.0), (0.0, 0.1, -1.0), 0.4)
    write_viewpoints(tmp_path / "one.csv", pose)
    loaded = read_viewpoints(tmp_path / "one.csv")
    assert loaded.names == ("v1",)
    assert float(jnp.abs((loaded.base_from_tool.inverse() @ pose).log()).max()) < 1e-9


def test_a_val_program_moves_to_the_poses(tmp_path):
    write_viewpoints(tmp_path / "v.val", POSES)
    text = (tmp_path / "v.val").read_text()
    assert text == val_program(POSES)
    lines = text.splitlines()
    assert lines[1::2] == [f"MOVE v{k}" for k in range(1, 6)]
    for k, line in enumerate(lines[0::2]):
        assert line.startswith(f"SET v{1 + k} = TRANS(")
        numbers = np.array(line[line.index("(") + 1 : -1].split(","), dtype=float)
        numbers *= np.repeat([1e-3, np.pi / 180.0], 3)
        pose = se3_from_xyzoat(jnp.asarray(numbers))
        off = (pose.inverse() @ SE3(POSES.wxyz_xyz[k])).log()
        assert float(jnp.abs(off).max()) < 2e-6


def test_what_no_robot_can_do_is_refused_and_nothing_written(tmp_path):
    def moved(view, column, value):
        return SE3(POSES.wxyz_xyz.at[view, column].set(value))

    path = tmp_path / "v.csv"
    with pytest.raises(ValueError, match="view v3: y is nan"):
        write_viewpoints(path, moved(2, 5, jnp.nan))
    with pytest.raises(ValueError, match=r"view v1: x is 451 m.*millimetres given as metres"):
        write_viewpoints(path, moved(0, 4, 451.0))
    bad = JOINTS.copy()
    bad[4, 1] = np.inf
    with pytest.raises(ValueError, match="view v5: joint 2 is inf"):
        write_viewpoints(path, POSES, joints=bad)
    with pytest.raises(ValueError, match="5 poses, but 2 names"):
        write_viewpoints(path, POSES, ("a", "b"))
    with pytest.raises(ValueError, match="view a: named more than once"):
        write_viewpoints(path, POSES, ("a", "a", "b", "c", "d"))
    with pytest.raises(ValueError, match="VAL names a location"):
        write_viewpoints(tmp_path / "v.val", POSES, ("1st", "b", "c", "d", "e"))
    with pytest.raises(ValueError, match="ending in"):
        write_viewpoints(tmp_path / "v.txt", POSES)
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_read_is_named(tmp_path):
    path = tmp_path / "v.csv"
    write_viewpoints(path, POSES)
    text = path.read_text().splitlines()
    text[2] = ",".join([*text[2].split(",")[:-1], "nan"])
    path.write_text("\n".join(text))
    with pytest.raises(ValueError, match=r"v\.csv: .*row v2 contains NaN"):
        read_viewpoints(path)
    with pytest.raises(ValueError, match="ending in"):
        read_viewpoints(tmp_path / "v.val")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda content: content.update(format="kuka"), "format is one of .*'kuka'; did you mean"),
        (lambda content: content.update(format="ur"), "units: expected .*'m'.* found .*'mm'"),
        (lambda content: content.update(columns=["x", "y", "z", "W", "P", "R"]), "columns: exp"),
        (lambda content: content["viewpoints"][1].pop("pose"), "viewpoints.1: expected either"),
        (lambda content: content["viewpoints"][1].update(xyzoat=[0.0] * 6), "viewpoints.1: exp"),
        (lambda content: content["viewpoints"][1]["pose"].append(0.0), "view v2: pose: expected 6"),
        (lambda content: content["viewpoints"][1].update(pose=[0.0] * 20), "viewpoints.1.pose: "),
        (
            lambda content: content["viewpoints"][1].update(
                xyzoat=content["viewpoints"][1].pop("pose")
            ),
            "view v2: pose: expected 6",
        ),
        (lambda content: content.update(viewpoints=[]), "no viewpoints"),
    ],
)
def test_what_is_wrong_in_another_makers_file_is_named(tmp_path, change, message):
    path = tmp_path / "v.json"
    write_viewpoints(path, POSES, pose_format="kuka_abc")
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=rf"v\.json: .*{message}"):
        read_viewpoints(path)


def test_a_file_without_a_format_has_vals(tmp_path):
    write_viewpoints(tmp_path / "v.json", POSES)
    content = json.loads((tmp_path / "v.json").read_text())
    del content["format"], content["columns"]
    (tmp_path / "v.json").write_text(json.dumps(content))
    loaded = read_viewpoints(tmp_path / "v.json").base_from_tool
    np.testing.assert_allclose(loaded.as_matrix(), POSES.as_matrix(), atol=1e-12)


def test_a_hand_acts_where_its_opening_changes_and_corners_are_not_cut(tmp_path):
    hand = HandSteps((True, False, True, True, False), (0.0, 0.05, 0.05, 0.02, 0.0))
    words = [line for line in val_program(POSES, hand=hand).splitlines() if "SET" not in line]
    assert words == [
        "CLOSEI", "MOVES v1",
        "OPENI 50.00", "MOVE v2",
        "BREAK", "MOVES v3",
        "OPENI 20.00", "MOVES v4",
        "CLOSEI", "MOVE v5",
    ]  # fmt: skip
    # Of viewpoints, which have no hand, nothing of it is written.
    assert not {"OPENI", "CLOSEI", "BREAK", "MOVES"} & set(val_program(POSES).split())
    for ending in ("csv", "json"):
        path = tmp_path / f"views.{ending}"
        write_viewpoints(path, POSES)
        assert "opening" not in path.read_text()
        assert "motion" not in path.read_text()


@pytest.mark.parametrize("ending", ["val", "csv", "json"])
@pytest.mark.parametrize(
    ("hand", "named"),
    [
        (HandSteps((True,) * 4, (0.05,) * 5), "each of 5 poses, found 4 in straight and 5 in"),
        (HandSteps((True,) * 5, (0.05,) * 4), "found 5 in straight and 4 in opening"),
        (HandSteps((True,) * 5, (np.nan,) * 5), "opening: expected metres, 0 or more, found nan"),
        (HandSteps((True,) * 5, (-0.01,) * 5), r"found -0\.01"),
    ],
)
def test_a_hand_that_does_not_fit_is_refused(tmp_path, ending, hand, named):
    path = tmp_path / f"views.{ending}"
    with pytest.raises(ValueError, match=named):
        write_viewpoints(path, POSES, hand=hand)
    assert not path.exists()
