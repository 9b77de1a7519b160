import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.io import load_urdf, urdf_joint_names

pytest.importorskip("urdf_parser_py")

LIMIT = '<limit lower="-2.5" upper="1.5" effort="1" velocity="1"/>'


def joint(name, parent, child, kind="revolute", xyz="0 0 0", rpy="0 0 0", axis="0 0 1", more=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>'
        f"{LIMIT if kind != 'fixed' else ''}{more}</joint>"
    )


def urdf(tmp_path, *joints):
    """A file of these joints; a mesh that is not there is not missed."""
    root = ElementTree.fromstring(f'<robot name="test">{"".join(joints)}</robot>')
    links = {part.get("link") for j in root for part in j if part.tag in ("parent", "child")}
    mesh = '<visual><geometry><mesh filename="package://none/no.stl"/></geometry></visual>'
    bodies = "".join(f'<link name="{link}">{mesh}</link>' for link in sorted(links))
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="test">{bodies}{"".join(joints)}</robot>')
    return path


def forward(joints, readings):
    """As the format defines it: origins and motions, one after the other."""
    pose, left = np.eye(4), list(readings)
    for text in joints:
        element = ElementTree.fromstring(text)
        origin, axis = (
            element.find("origin"),
            np.array(element.find("axis").get("xyz").split(), float),
        )
        rpy = np.array(origin.get("rpy").split(), float)
        step, motion = np.eye(4), np.eye(4)
        step[:3, :3] = Rotation.from_euler("xyz", rpy).as_matrix()
        step[:3, 3] = np.array(origin.get("xyz").split(), float)
        axis /= np.linalg.norm(axis)
        if element.get("type") == "prismatic":
            motion[:3, 3] = left.pop(0) * axis
        elif element.get("type") != "fixed":
            motion[:3, :3] = Rotation.from_rotvec(left.pop(0) * axis).as_matrix()
        pose = pose @ step @ motion
    return pose


def serial(rows):
    return [joint(f"j{k}", f"l{k}", f"l{k + 1}", *row) if row else "" for k, row in enumerate(rows)]


R = "1.5707963267948966"
CHAINS = {
    "kuka": [  # axes that meet, up and across in turn
        ("revolute", "0 0 0.31", "0 0 0"),
        ("revolute", "0 0 0", f"{R} 0 0"),
        ("continuous", "0 0.4 0", f"-{R} 0 0"),
        ("revolute", "0 0 0", f"-{R} 0 0"),
        ("fixed", "0 0 0.078", "0 0 0.3"),
    ],
    "ur": [  # three parallel axes, named by y
        ("revolute", "0 0 0.089", "0 0 0", "0 0 1"),
        ("revolute", "0 0.136 0", f"0 {R} 0", "0 1 0"),
        ("revolute", "0 -0.12 0.425", "0 0 0", "0 1 0"),
        ("revolute", "0 0 0.392", f"0 {R} 0", "0 1 0"),
        ("revolute", "0 0.093 0", "0 0 0", "0 0 1"),
        ("revolute", "0 0 0.095", "0 0 0", "0 1 0"),
        ("fixed", "0 0.082 0", f"0 0 {R}", "0 0 1"),
    ],
    "skew": [
        ("fixed", "0.1 0.2 0.3", "0.1 -0.2 0.3"),
        ("revolute", "0.3 -0.1 0.2", "0.5 0.1 -0.7", "1 2 -1"),
        ("prismatic", "0 0.2 0.1", "0.2 -0.4 0.1", "0.3 0 1"),
        ("continuous", "-0.1 0.2 0", "1 1 1", "0 -1 0"),
    ],
}


@pytest.mark.parametrize("name", CHAINS)
def test_the_tool_is_where_the_format_puts_it(tmp_path, name):
    joints = serial(CHAINS[name])
    arm = load_urdf(urdf(tmp_path, *joints))
    for readings in np.random.default_rng(0).uniform(-2.0, 2.0, (5, arm.joint_count)):
        actual = np.asarray(arm.base_from_tool(readings).as_matrix())
        np.testing.assert_allclose(actual, forward(joints, readings), atol=1e-12)


def test_a_second_reader_agrees(tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    path = urdf(tmp_path, *serial(CHAINS["ur"]))
    theirs, arm = (
        yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True),
        load_urdf(path),
    )
    readings = np.random.default_rng(1).uniform(-1.0, 1.0, 6)
    theirs.update_cfg(readings)
    actual = np.asarray(arm.base_from_tool(readings).as_matrix())
    np.testing.assert_allclose(actual, theirs.get_transform("l7", "l0"), atol=1e-9)


def test_limits_and_sliding_joints_are_kept(tmp_path):
    arm = load_urdf(urdf(tmp_path, *serial(CHAINS["skew"])))
    assert arm.prismatic == (False, True, False)
    np.testing.assert_array_equal(arm.limits, [[-2.5, 1.5], [-2.5, 1.5], [-np.inf, np.inf]])


def test_part_of_a_chain(tmp_path):
    joints = serial(CHAINS["ur"])
    arm = load_urdf(urdf(tmp_path, *joints), base="l1", tip="l4")
    assert arm.joint_count == 3
    actual = np.asarray(arm.base_from_tool(np.full(3, 0.3)).as_matrix())
    np.testing.assert_allclose(actual, forward(joints[1:4], np.full(3, 0.3)), atol=1e-12)


def test_what_is_no_chain_is_refused(tmp_path):
    two = [joint("a", "l0", "l1"), joint("b", "l0", "l2")]
    with pytest.raises(ValueError, match=r"branches: give tip=, such as one of \['l1', 'l2'\]"):
        load_urdf(urdf(tmp_path, *two))
    assert load_urdf(urdf(tmp_path, *two), tip="l2").joint_count == 1
    with pytest.raises(ValueError, match="no chain from link l2 to link l1"):
        load_urdf(urdf(tmp_path, *two), base="l2", tip="l1")
    with pytest.raises(ValueError, match="tip='hand': no such link"):
        load_urdf(urdf(tmp_path, *two), tip="hand")
    with pytest.raises(ValueError, match="2 root links"):
        load_urdf(urdf(tmp_path, joint("a", "l0", "l1"), joint("b", "m0", "m1")))
    with pytest.raises(ValueError, match="no joint moves"):
        load_urdf(urdf(tmp_path, joint("a", "l0", "l1", "fixed")))


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_joints_of_more_freedoms_are_refused(tmp_path, kind):
    with pytest.raises(ValueError, match=f"joint a is {kind}"):
        load_urdf(urdf(tmp_path, joint("a", "l0", "l1", kind)))


def test_wrong_files_are_named(tmp_path):
    mimic = joint("b", "l1", "l2", more='<mimic joint="a"/>')
    with pytest.raises(ValueError, match="joint b mimics a"):
        load_urdf(urdf(tmp_path, joint("a", "l0", "l1"), mimic))
    with pytest.raises(ValueError, match="joint 1: the axis has no direction"):
        load_urdf(urdf(tmp_path, joint("a", "l0", "l1", axis="0 0 0")))
    with pytest.raises(FileNotFoundError):
        load_urdf(tmp_path / "missing.urdf")
    (tmp_path / "other.urdf").write_text("not xml")
    with pytest.raises(ValueError, match=r"other\.urdf: not a URDF file"):
        load_urdf(tmp_path / "other.urdf")


def test_the_joints_that_move_are_named_in_the_order_of_the_arm(tmp_path):
    joints = (
        joint("wrist", "upper", "hand"),
        joint("weld", "hand", "tool", "fixed"),
        joint("shoulder", "base", "upper"),
        joint("finger", "tool", "tip", "prismatic"),
    )
    path = urdf(tmp_path, *joints)
    assert urdf_joint_names(path) == ("shoulder", "wrist", "finger")
    assert urdf_joint_names(path, "base", "tool") == ("shoulder", "wrist")
    assert load_urdf(path, "base", "tool").joint_count == 2
