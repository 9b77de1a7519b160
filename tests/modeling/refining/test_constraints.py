import dataclasses

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from smartview_jax.modeling import (
    EqualLength,
    KnownLength,
    LineIndex,
    Lines,
    OnPlane,
    Parallel,
    RightAngle,
    SamePlane,
    Symmetric,
)
from smartview_jax.modeling.refining.constraint_geometry import Shape
from smartview_jax.modeling.refining.constraints import check_constraints

CASES = [
    SamePlane((0, 2, 3, 4)),
    OnPlane((0, 3), (0.6, 0.0, 0.8), 0.1),
    Parallel((0, 1), (2, 4)),
    Parallel((0, 1), LineIndex(1)),
    RightAngle((0, 1), (1, 4)),
    RightAngle(LineIndex(0), LineIndex(1)),
    EqualLength((0, 1), (1, 2)),
    KnownLength((3, 4), 0.2),
    Symmetric(((0, 1), (2, 3), (4, 4))),
]


@pytest.fixture
def shape():
    rng = np.random.default_rng(3)
    directions = rng.standard_normal((2, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    normal = rng.standard_normal((1, 3))
    return Shape(
        rng.uniform(-0.2, 0.2, (5, 3)),
        Lines(rng.uniform(-0.2, 0.2, (2, 3)), directions),
        normal / np.linalg.norm(normal),
        np.array([0.03]),
        np.array([[0.1, 0.0, -0.05]]),
    )


@pytest.mark.parametrize("constraint", CASES, ids=lambda one: str(one)[:40])
def test_derivatives_are_those_of_differences(constraint, shape):
    sizes = {"point": (5, 3), "line": (2, 4), "plane": (1, 3)}

    if isinstance(constraint, Parallel):
        # Across two axes that turn with the first edge: only to first order about parallels.
        u = shape.points[1] - shape.points[0]
        shape.points[4] = shape.points[2] + 0.7 * u
        shape.lines.directions[1] = u / np.linalg.norm(u)
        assert np.abs(constraint.evaluate(shape, 0).values).max() < 1e-12

    def values(steps):
        parts = np.split(steps, np.cumsum([k * n for k, n in sizes.values()])[:-1])
        steps = [p.reshape(size) for p, size in zip(parts, sizes.values(), strict=True)]
        return constraint.evaluate(shape.moved(*steps), 0).values

    start = np.zeros(sum(k * n for k, n in sizes.values()))
    expected = approx_fprime(start, values, 1e-7).reshape(-1, len(start))
    actual, first = np.zeros_like(expected), {"point": 0, "line": 15, "plane": 23}
    for (kind, k), jacobian in constraint.evaluate(shape, 0).jacobians.items():
        width = sizes[kind][1]
        actual[:, first[kind] + width * k : first[kind] + width * (k + 1)] = jacobian
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_what_holds_is_zero():
    """On a box of 3 x 2 x 1, whose vertices are numbered by their bits."""
    box = np.array([[3.0 * (k & 1), 2.0 * (k >> 1 & 1), 1.0 * (k >> 2)] for k in range(8)])
    held = [
        SamePlane((0, 1, 2, 3)),
        OnPlane((4, 5, 6, 7), offset=1.0),
        Parallel((0, 1), (7, 6)),
        RightAngle((0, 1), (1, 3)),
        EqualLength((0, 2), (5, 7)),
        KnownLength((0, 4), 1.0),
        Symmetric(((0, 1), (2, 3), (4, 5), (6, 7))),
    ]
    for constraint in held:
        centre, normal = constraint.initial_plane(box) or (np.zeros(3), np.eye(3)[0])
        shape = Shape(box, Lines(np.zeros((0, 3)), np.zeros((0, 3))), normal[None], np.zeros(1),
                      centre[None])  # fmt: skip
        np.testing.assert_allclose(constraint.evaluate(shape, 0).values, 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "wrong",
    [
        lambda: SamePlane((0, 1, 2)),
        lambda: SamePlane((0, 1, 2, 2)),
        lambda: KnownLength((0, 0), 0.1),
        lambda: KnownLength((0, 1), -0.1),
        lambda: RightAngle((0, 1), (1, 2), sigma=0.0),
        lambda: OnPlane((0,), normal=(0.0, 0.0, 2.0)),
        lambda: Symmetric(((1, 1),)),
        lambda: RightAngle((0, 1), (1, 0)),
        lambda: Parallel(LineIndex(0), LineIndex(0)),
        lambda: check_constraints([KnownLength((0, 9), 0.1)], 5, 0),
        lambda: check_constraints([Parallel((0, 1), LineIndex(2))], 5, 2),
    ],
)
def test_what_makes_no_sense_is_refused(wrong):
    with pytest.raises(ValueError, match=r"\(.*\)"):
        wrong()


def test_a_constraint_is_told_in_words():
    constraint = KnownLength((0, 1), 0.1, sigma=1e-4)
    assert "KnownLength(sigma=0.0001, edge=(0, 1), length=0.1)" in str(constraint)
    assert dataclasses.replace(constraint, sigma=None).sigma is None


@pytest.mark.parametrize("scale", [0.01, 1.0, 40.0])
def test_angles_between_edges_do_not_depend_on_their_lengths(shape, scale):
    """By trigonometry: the cosine of a right angle that is off, the sine of parallels that are."""
    off = 0.1
    corner = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [np.cos(off), np.sin(off), 0.0]])
    shape.points[:3] = scale * corner
    parallel = Parallel((0, 1), (0, 2)).evaluate(shape, 0).values
    assert np.linalg.norm(parallel) == pytest.approx(np.sin(off), rel=1e-9)
    right = RightAngle((0, 1), (0, 2)).evaluate(shape, 0).values
    assert np.abs(right) == pytest.approx(np.cos(off), rel=1e-9)
