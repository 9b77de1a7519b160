import jax
import jax.numpy as jnp
import numpy as np
import pytest
from host_poses import motion_between
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxlie import SO3
from scipy.spatial.transform import Rotation

from smartview_jax.geometry import (
    EULER_CODECS,
    EULER_CONVENTIONS,
    POSE_CODECS,
    as_se3,
    host_exponentials,
    host_transforms,
    oat_from_rotation,
    pose_codec,
    rotation_from_oat,
    se3_from_xyzoat,
    xyzoat,
    ypr_from_rotation,
)


def _hard_rotations():
    """Random, near identity, near half turns, and at every convention's singularities."""
    rng = np.random.default_rng(0)
    vectors = [*rng.normal(size=(30, 3)), *(1e-7 * rng.normal(size=(10, 3))), np.zeros(3)]
    axes = rng.normal(size=(10, 3))
    vectors += list((np.pi - 1e-6) * axes / np.linalg.norm(axes, axis=1, keepdims=True))
    vectors += [np.pi * axis for axis in np.eye(3)]
    rotations = [Rotation.from_rotvec(v) for v in vectors]
    for o, t in rng.uniform(-np.pi, np.pi, (6, 2)):
        for a in (90.0, -90.0, 90.0 - 1e-9, 89.999, -89.999):
            middle = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
            R = Rotation.from_euler("z", o).as_matrix() @ middle
            R = R @ Rotation.from_euler("y", a, degrees=True).as_matrix()
            rotations.append(Rotation.from_matrix(R) * Rotation.from_euler("z", t))
            rotations.append(Rotation.from_euler("ZYX", [o, np.deg2rad(a), t]))
        rotations += [
            Rotation.from_euler("ZYZ", [o, b, t]) for b in (0.0, np.pi, 1e-9, np.pi - 1e-5)
        ]
    return np.stack([rotation.as_matrix() for rotation in rotations])


MATRICES = _hard_rotations()
POSES = np.tile(np.eye(4), (len(MATRICES), 1, 1))
POSES[:, :3, :3] = MATRICES
POSES[:, :3, 3] = np.random.default_rng(1).normal(size=(len(MATRICES), 3))
POSES = host_transforms(POSES)

# One program for each shape; without `jit` every operation is one.
rotation_matrix = jax.jit(lambda oat: rotation_from_oat(oat).as_matrix())


@pytest.mark.parametrize("name", [*POSE_CODECS, *EULER_CODECS])
@pytest.mark.parametrize("units", [("m", "rad"), ("mm", "deg")])
def test_poses_are_read_as_they_were_written(name, units):
    codec = pose_codec(name)
    rows = codec.encode(POSES, *units)
    assert rows.shape == (len(MATRICES), len(codec.columns))
    assert np.isfinite(rows).all()
    back = codec.decode(rows, *units)
    np.testing.assert_allclose(back.as_matrix(), POSES.as_matrix(), atol=2e-7)
    # Away from the singularities to rounding.
    np.testing.assert_allclose(back.as_matrix()[:30], POSES.as_matrix()[:30], atol=1e-12)


def test_matrices_become_transforms_as_by_jaxlie():
    """Also matrices of few digits, and mirrored ones, which SciPy refuses or makes rigid."""
    poses = np.tile(np.eye(4), (3 * len(MATRICES), 1, 1))
    rotations = np.concatenate([MATRICES, np.round(MATRICES, 4), -MATRICES])
    poses[:, :3, :3] = rotations
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(len(poses), 3))
    by_jaxlie = as_se3(jnp.asarray(poses)).wxyz_xyz
    np.testing.assert_allclose(as_se3(poses).wxyz_xyz, by_jaxlie, rtol=0.0, atol=1e-15)
    one = as_se3(poses[0])
    assert one.get_batch_axes() == ()
    np.testing.assert_allclose(one.as_matrix(), poses[0], atol=1e-15)


@given(
    st.tuples(*(st.floats(-3.0, 3.0),) * 6),
    st.sampled_from(sorted({**POSE_CODECS, **EULER_CODECS})),
)
@settings(max_examples=40, deadline=None)
def test_round_trip_of_anything(tangent, name):
    pose = host_transforms(host_exponentials(np.array([tangent])))
    codec = pose_codec(name)
    back = codec.decode(codec.encode(pose, "mm", "deg"), "mm", "deg")
    np.testing.assert_allclose(back.as_matrix(), pose.as_matrix(), atol=1e-6)


@pytest.mark.parametrize(
    ("name", "sequence"),
    [
        ("yaw_pitch_roll", "ZYX"),
        ("kuka_abc", "ZYX"),
        ("kawasaki_oat", "ZYZ"),
        ("staubli_val3", "XYZ"),
        ("doosan", "ZYZ"),
        ("comau", "ZYZ"),
        ("epson", "ZYX"),
        *((name, "xyz") for name in ("xarm", "yaskawa", "denso", "techman", "mitsubishi")),
        *(
            (name, axes if moving else axes.lower())
            for name, (axes, moving) in EULER_CONVENTIONS.items()
        ),
    ],
)
def test_angles_agree_with_scipy(name, sequence):
    angles = np.random.default_rng(2).uniform(-1.4, 1.4, (20, 3))
    if sequence[0] == sequence[2]:
        angles[:, 1] += 1.5  # the second angle runs from 0 to 180 degrees
    rows = np.concatenate([np.zeros((20, 3)), np.rad2deg(angles)], axis=1)
    actual = pose_codec(name).decode(rows, "mm", "deg").rotation().as_matrix()
    expected = Rotation.from_euler(sequence, angles)
    np.testing.assert_allclose(actual, expected.as_matrix(), atol=1e-12)
    written = pose_codec(name).encode(pose_codec(name).decode(rows, "mm", "deg"), "mm", "deg")
    np.testing.assert_allclose(written[:, 3:], expected.as_euler(sequence, degrees=True), atol=1e-9)


def test_fanuc_is_x_first_about_fixed_axes():
    row = [[1.0, 2.0, 3.0, 10.0, 20.0, 30.0]]
    pose = pose_codec("fanuc_wpr").decode(np.array(row), "mm", "deg")
    expected = Rotation.from_euler("xyz", [10.0, 20.0, 30.0], degrees=True).as_matrix()
    np.testing.assert_allclose(pose.rotation().as_matrix()[0], expected, atol=1e-12)
    np.testing.assert_allclose(pose.translation()[0], [1e-3, 2e-3, 3e-3], atol=1e-15)


@pytest.mark.parametrize("name", ["quaternion_xyzw", "quaternion_wxyz", "abb"])
def test_quaternions_agree_with_scipy(name):
    rotation = Rotation.from_rotvec([0.3, -0.2, 0.9])
    numbers = rotation.as_quat(scalar_first=name != "quaternion_xyzw")
    pose = pose_codec(name).decode(np.array([[0.0, 0.0, 0.0, *numbers]]))
    np.testing.assert_allclose(pose.rotation().as_matrix()[0], rotation.as_matrix(), atol=1e-12)


def test_eq_18_as_it_is_written_out():
    """Against the product of elementary rotations, and VAL's own words at zero."""
    O, A, T = 0.4, -0.7, 2.1

    def about(axis, angle):
        return Rotation.from_euler(axis, angle).as_matrix()

    M0 = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]])
    expected = about("z", O) @ about("x", A) @ M0 @ about("z", T)
    actual = rotation_matrix(np.array([O, A, T]))
    np.testing.assert_allclose(actual, expected, atol=1e-15)
    zero = np.asarray(rotation_matrix(np.zeros(3)))
    np.testing.assert_allclose(zero[:, 2], [0.0, -1.0, 0.0], atol=1e-15)  # points along -y


def test_both_branches_of_oat_are_the_same_rotation():

    @jax.jit
    def both(rotation):
        return [oat_from_rotation(rotation, other_branch=other) for other in (False, True)]

    principal, other = map(np.asarray, both(SO3(jnp.asarray(POSES.wxyz_xyz[:, :4]))))
    for branch in (principal, other):
        np.testing.assert_allclose(rotation_matrix(branch), MATRICES, atol=2e-7)
    assert np.abs(principal[:, 1]).max() <= np.pi / 2 + 1e-12


@jax.jit
def given_and_plain(oat):
    """The angles of a rotation, with O given at the gimbal and without."""
    rotation = rotation_from_oat(oat)
    return oat_from_rotation(rotation, gimbal_o=0.5), oat_from_rotation(rotation)


@pytest.mark.parametrize("a", [90.0, -90.0])
def test_straight_down_and_up_keep_the_given_o(a):
    wanted = np.array([0.5, np.deg2rad(a), 1.2])
    kept, plain = given_and_plain(wanted)
    np.testing.assert_allclose(kept, wanted, atol=1e-7)
    assert plain[0] == 0.0
    np.testing.assert_allclose(rotation_matrix(plain), rotation_matrix(wanted), atol=1e-7)


def test_commands_rounded_together_near_the_gimbal_keep_the_orientation():
    """At A = 89 degrees, O and T rounded to 0.01 degrees cost no more than that rounding."""
    poses = jax.jit(se3_from_xyzoat)
    pose = poses(np.array([0.1, 0.2, 0.3, 0.70011, np.deg2rad(89.0), -1.2004]))
    numbers = np.asarray(jax.jit(xyzoat)(pose))
    rounded = np.concatenate([numbers[:3], np.deg2rad(np.round(np.rad2deg(numbers[3:]), 2))])
    turn = motion_between(pose, poses(rounded))[3:]
    assert np.rad2deg(np.linalg.norm(turn)) < 0.011


def test_angles_are_differentiable_away_from_the_gimbal():

    @jax.jit
    def angles_and_derivatives(vector):
        def angles(vector):
            rotation = SO3.exp(vector)
            return jnp.concatenate([oat_from_rotation(rotation), ypr_from_rotation(rotation)])

        return angles(vector), jax.jacfwd(angles)(vector)

    vector, step = np.array([0.3, 0.2, -0.4]), 1e-6 * np.eye(3)
    J = angles_and_derivatives(vector)[1]
    for k in range(3):
        up, down = (
            np.asarray(angles_and_derivatives(vector + s * step[k])[0]) for s in (1.0, -1.0)
        )
        np.testing.assert_allclose(J[:, k], (up - down) / 2e-6, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "row", "message"),
    [
        ("quaternion_xyzw", [0, 0, 0, 0, 0, 0, 2.0], "row a has a quaternion of length 2, not 1"),
        ("val_oat", [0, 0, np.nan, 0, 0, 0], "row a contains NaN"),
        ("val_oat", [0, 0, 0], r"expected rows of 6 numbers \(x, y, z, O, A, T\)"),
        ("matrix", [*np.diag([1.0, 1.0, -1.0, 1.0]).ravel()], "row a: .*mirrored"),
    ],
)
def test_bad_rows_are_named(name, row, message):
    with pytest.raises(ValueError, match=message):
        pose_codec(name).decode(np.array([row]), labels=["a"])


def test_unknown_names_are_answered_with_the_known_ones():
    with pytest.raises(ValueError, match=r"matrix, quaternion_xyzw.*found 'euler'"):
        pose_codec("euler")
    with pytest.raises(ValueError, match="length_unit is one of m, cm, mm; found 'inch'"):
        pose_codec("ur").decode(np.zeros((1, 6)), length_unit="inch")
    with pytest.raises(ValueError, match="angle_unit is one of rad, deg; found 'grad'"):
        pose_codec("ur").encode(POSES, angle_unit="grad")


@pytest.mark.parametrize("name", ["kuka_abc", "ur", "val_oat"])
def test_degrees_where_radians_are_stated_are_refused(name):
    """Once read as radians they are whatever is left of them after many turns."""
    codec = pose_codec(name)
    rows = np.array([[0.4, 0.1, 0.3, 12.0, -3.0, 178.0], [0.4, 0.1, 0.3, 10.0, -3.0, -170.0]])
    with pytest.raises(ValueError, match=f"{name}: angles up to 178 are too large for radians"):
        codec.decode(rows)
    assert codec.decode(rows, angle_unit="deg").get_batch_axes() == (2,)
