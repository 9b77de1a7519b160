import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.robots import Gripper
from smartview_jax.simulation import CellError, CellObject, Physics, box, stepped_block
from smartview_jax.simulation.cell.physics_model import GRIP_FORCE

pytest.importorskip("mujoco")

BOX = box(0.06, 0.04, 0.03)
DOWN = np.array([[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [0, 0, 0, 1.0]])
"""The gripper above the origin, fingers downwards, closing along the world's y axis."""


def pose(x=0.0, y=0.0, z=0.0, rotation=None):
    matrix = np.eye(4) if rotation is None else rotation.copy()
    matrix[:3, 3] = x, y, z
    return matrix


def physics(*objects, fixtures=()):
    simulation = Physics(objects, fixtures, Gripper(), (0.0, 0.0), (0.3, 0.3))
    simulation.place_gripper(pose(z=0.3, rotation=DOWN))
    return simulation


def lifted_by(simulation, offset=0.0):
    """How far the first object rises when it is grasped and the gripper goes up 0.14 m."""
    height = simulation.world_from_object(0)[2, 3]
    simulation.place_gripper(pose(offset, z=0.1, rotation=DOWN))
    simulation.move_fingers(0.07)
    simulation.lead_gripper(pose(offset, z=0.012, rotation=DOWN))
    simulation.move_fingers(0.0)
    simulation.lead_gripper(pose(offset, z=0.152, rotation=DOWN))
    return simulation.world_from_object(0)[2, 3] - height


@pytest.mark.parametrize("solid", [BOX, stepped_block(0.05)], ids=["box", "prism"])
def test_what_falls_rests_on_a_face(solid):
    simulation = physics(CellObject("it", solid))
    tilted = np.eye(4)
    tilted[:3, :3] = Rotation.from_euler("xyz", [0.5, 0.3, 1.0]).as_matrix()
    simulation.place(0, pose(z=0.08, rotation=tilted))
    simulation.fall()
    heights = np.sort(solid.moved(simulation.world_from_object(0)).vertices[:, 2])
    # Three points or more on the table, to a tenth of a millimetre, and none below.
    assert np.all(np.abs(heights[:3]) < 1e-4)
    assert heights[0] > -1e-5


def test_a_stack_stands_and_loses_energy():
    """It loses what it falls, and no contact gives any of it back but for its springs' part."""
    simulation = physics(*(CellObject(name, BOX) for name in "abc"))
    for k in range(3):
        simulation.place(k, pose(0.004 * k, z=0.03 * k + 0.002 * (k + 1)))
    energies = [simulation.energy]
    for _ in range(12):
        simulation._run(0.05, lambda: False)
        energies.append(simulation.energy)
    mass = 600.0 * 0.06 * 0.04 * 0.03
    lost = mass * 9.81 * (0.002 + 0.004 + 0.006)
    assert np.all(np.diff(energies) < 0.02 * lost)
    assert np.isclose(energies[0] - energies[-1], lost, rtol=0.02)
    simulation.settle()
    tops = [simulation.world_from_object(k)[2, 3] for k in range(3)]
    assert np.allclose(tops, [0.0, 0.03, 0.06], atol=1e-4)


WEIGHT = 600.0 * 0.06 * 0.04 * 0.03 * 9.81
FRICTION_LIMIT = WEIGHT / (2.0 * GRIP_FORCE)
"""Two fingers hold 2 mu F, N."""


def test_a_grasp_at_the_object_lifts_it_and_one_next_to_it_does_not():
    """With twice the friction that its weight needs."""
    simulation = physics(CellObject("box", BOX, friction=2.0 * FRICTION_LIMIT))
    simulation.settle()
    assert abs(lifted_by(simulation) - 0.14) < 1e-3
    assert simulation.touched_by_fingers() == {"left": {0}, "right": {0}}
    assert abs(simulation.opening - 0.04) < 1e-3
    missed = physics(CellObject("box", BOX))
    missed.settle()
    # 30 mm from its end, and so with empty fingers.
    assert abs(lifted_by(missed, offset=0.06)) < 1e-3
    assert missed.opening < 1e-3


def test_what_is_too_heavy_for_the_friction_slips():
    """At 1.5 times the weight that the fingers hold the object stays on the table."""
    slippery = physics(CellObject("box", BOX, friction=FRICTION_LIMIT / 1.5))
    slippery.settle()
    assert lifted_by(slippery) < 0.02


def test_the_gripper_is_where_it_is_led():
    simulation = physics()
    target = pose(0.05, -0.03, 0.2, DOWN)
    target[:3, :3] = Rotation.from_euler("z", 0.4).as_matrix() @ target[:3, :3]
    simulation.lead_gripper(target)
    assert np.allclose(simulation.world_from_gripper, target, atol=1e-5)


def test_an_unstable_simulation_says_so():
    simulation = physics(CellObject("box", BOX))
    simulation._data.joint("o0").qvel[:] = 1e12
    with pytest.raises(CellError, match="became unstable"):
        simulation.settle()
    with pytest.raises(CellError, match="drop the objects again"):
        simulation.settle()


def test_an_interrupted_motion_is_not_gone_on_with():
    simulation = physics(CellObject("box", BOX))

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulation._run(1.0, interrupt)
    with pytest.raises(CellError, match="was interrupted"):
        simulation.move_fingers(0.02)


def test_objects_that_do_not_rest_are_an_error(monkeypatch):
    monkeypatch.setattr("smartview_jax.simulation.cell.physics.MAX_FALL_TIME", 0.05)
    simulation = physics(CellObject("box", BOX))
    simulation.place(0, pose(z=0.2))
    with pytest.raises(CellError, match="still moving"):
        simulation.settle()
