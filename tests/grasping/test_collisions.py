import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from smartview_jax.grasping import Obstacle
from smartview_jax.grasping.collisions import (
    CollisionChecker,
    arm_links,
    closing_fingers,
    swept_gripper,
    swept_links,
    swept_object,
)
from smartview_jax.robots import Gripper
from smartview_jax.simulation import box, stepped_block

pytest.importorskip("fcl")
trimesh = pytest.importorskip("trimesh")

DOWN = np.diag([1.0, -1.0, -1.0, 1.0])


def at(x=0.0, y=0.0, z=0.0, rotation=None):
    pose = np.eye(4) if rotation is None else rotation.copy()
    pose[:3, 3] = x, y, z
    return pose


def nearest(obstacles, pose, translation=(0.0, 0.0, 0.0), opening=0.04):
    parts = swept_gripper(Gripper(), opening, pose, np.array(translation))
    return CollisionChecker(obstacles).nearest(parts)


def test_the_distance_to_a_table_is_that_of_the_tips():
    contact = nearest([Obstacle.table()], at(z=0.0123, rotation=DOWN))
    assert contact.part in ("left finger", "right finger")
    assert contact.obstacle == "table"
    assert np.isclose(contact.clearance, 0.0123, atol=1e-6)


def test_the_distance_to_a_wall_is_from_the_finger_next_to_it():
    wall = Obstacle.box("wall", (0.01, 1.0, 0.1), at(x=0.1))
    # The right finger's outside is at 20 + 8 mm, the wall's at 95.
    contact = nearest([Obstacle.table(z=-1.0), wall], at(rotation=DOWN))
    assert contact.obstacle == "wall"
    palm = 0.5 * Gripper().palm[0]
    # The wall is higher than the fingers' upper ends are: the palm is nearer than they are.
    assert contact.part == "palm"
    assert np.isclose(contact.clearance, 0.095 - palm, atol=1e-6)


def test_a_thin_plate_between_the_two_ends_of_a_motion_is_not_missed():
    plate = Obstacle.box("plate", (0.3, 0.3, 1e-4), at(z=0.2))
    assert nearest([plate], at(z=0.01, rotation=DOWN)).clearance > 0.0
    swept = nearest([plate], at(z=0.01, rotation=DOWN), (0.0, 0.0, 0.4))
    assert swept.clearance == 0.0
    assert str(swept).endswith("touches plate")


def test_a_wall_between_an_open_finger_and_the_object_is_met_while_closing():
    """As in a bin: the open finger comes down outside of the wall, and neither end touches it."""
    gripper, wall = Gripper(), Obstacle.box("wall", (0.004, 0.2, 0.05), at(x=0.025, z=0.02))
    checker = CollisionChecker([wall])
    for opening in (0.08, 0.02):
        fingers = swept_gripper(gripper, opening, at(z=0.01, rotation=DOWN), np.zeros(3))
        assert checker.nearest(fingers).clearance > 0.0
    contact = checker.nearest(closing_fingers(gripper, 0.08, 0.02, at(z=0.01, rotation=DOWN)))
    assert contact.clearance == 0.0
    assert contact.part == "right finger"


def test_what_is_inside_an_obstacle_touches_it():
    block = Obstacle.box("block", (1.0, 1.0, 1.0), np.eye(4))
    assert nearest([block], DOWN).clearance == 0.0


def test_the_step_of_a_block_is_free_space():
    """A surface that is not convex is not replaced by its hull."""
    solid = stepped_block(0.2)
    block = Obstacle("block", solid.vertices, solid.triangles)
    hull = trimesh.convex.convex_hull(solid.vertices)
    # Above the step: inside the hull, outside the block.
    spot = at(0.06, 0.0, 0.06, DOWN)
    assert hull.contains(spot[:3, 3][None])[0]
    contact = nearest([block], spot, opening=0.01)
    assert 0.0 < contact.clearance < 0.02
    filled = Obstacle("filled", np.asarray(hull.vertices), np.asarray(hull.faces))
    assert nearest([filled], spot, opening=0.01).clearance == 0.0


def test_distances_are_those_of_trimesh():
    rng = np.random.default_rng(0)
    for _ in range(5):
        points = rng.standard_normal((10, 3)) * 0.03 + [0.2, 0.0, 0.0]
        hull = trimesh.convex.convex_hull(points)
        obstacle = Obstacle("hull", np.asarray(hull.vertices), np.asarray(hull.faces))
        parts = swept_gripper(Gripper(), 0.04, DOWN, np.zeros(3))
        manager = trimesh.collision.CollisionManager()
        manager.add_object("hull", hull)
        expected = min(
            manager.min_distance_single(trimesh.convex.convex_hull(corners))
            for corners in parts.values()
        )
        actual = CollisionChecker([obstacle]).nearest(parts).clearance
        assert np.isclose(actual, max(expected, 0.0), atol=1e-6)


def test_links_are_cylinders_about_the_lines_between_the_frames():
    origins = np.array([[0.0, 0, 0], [0, 0, 0.4], [0, 0, 0.4], [0.3, 0, 0.4]])
    links = arm_links(origins, 0.05)
    # Frames at one place have no link between them.
    assert list(links) == ["arm's link 1", "arm's link 3"]
    contact = CollisionChecker([Obstacle.box("box", (0.1, 0.1, 0.1), at(0.15, 0.0, 0.6))]).nearest(
        links
    )
    # From 0.4 m + 0.05 m up to 0.55 m; the prism about the cylinder has up to 5 % more.
    assert 0.0970 <= contact.clearance <= 0.1001


def held_contact(obstacle, vertices, up=0.1):
    swept = swept_object(vertices, np.array([0.0, 0.0, up]))
    contact = CollisionChecker([obstacle]).nearest(swept)
    assert contact.part == "held object"
    return contact.clearance


def block_at(gap, size=(0.1, 0.1, 0.3)):
    """A block at a gap from the side of a box of 60 mm x 40 mm x 30 mm."""
    return Obstacle.box("block", size, at(x=0.03 + gap + 0.5 * size[0]))


def above(gap):
    """A plate of 1 mm over the box's end."""
    return Obstacle.box("shelf", (0.02, 0.2, 1e-3), at(x=0.025, z=0.03 + gap + 5e-4))


def test_a_held_object_may_touch_what_it_stands_on_and_leans_against():
    vertices = box(0.06, 0.04, 0.03).vertices
    # It lies on the table, and errors of its pose put it half a millimetre into its neighbour.
    assert np.isclose(held_contact(Obstacle.table(), vertices), 1e-3, atol=1e-6)
    assert np.isclose(held_contact(block_at(0.0), vertices), 1e-3, atol=1e-6)
    assert np.isclose(held_contact(block_at(-5e-4), vertices), 5e-4, atol=1e-6)
    assert held_contact(block_at(-1.5e-3), vertices) == 0.0


def test_a_held_object_meets_what_is_above_it():
    vertices = box(0.06, 0.04, 0.03).vertices
    # Something that lies on it, too, would be lifted with it.
    for gap in (0.0, 5e-3, 0.09):
        assert held_contact(above(gap), vertices) == 0.0
    assert held_contact(above(0.11), vertices) > 0.0


def test_objects_that_are_thin_or_flat_are_swept_as_well():
    thin, flat = box(0.06, 0.04, 1e-3).vertices, box(0.06, 0.04, 0.03).vertices
    for vertices in (thin, flat[flat[:, 2] > 0.0], flat[flat[:, 0] > 0.0]):
        assert held_contact(Obstacle.table(), vertices) > 0.0
        assert held_contact(above(0.02), vertices) == 0.0
        # Next to it there is room all the same.
        assert held_contact(block_at(0.01), vertices) > 9e-3


def test_links_are_swept_between_the_steps_of_a_motion():
    """A link that swings by its own length past a post between the two ends."""
    ends = np.array([[[0.0, 0.0, 0.0], [0.4, 0.0, 0.1 * k]] for k in (0.0, 1.0)])
    post = CollisionChecker([Obstacle.box("post", (5e-3, 5e-3, 5e-3), at(x=0.38, z=0.05))])
    for origins in ends:
        assert post.nearest(arm_links(origins, 0.01)).clearance > 0.02
    (swept,) = swept_links(ends, 0.01)
    assert post.nearest(swept).clearance == 0.0
    assert str(post.nearest(swept)) == "the arm's link 1 touches post"


def test_obstacles_beyond_a_distance_are_not_looked_at():
    checker = CollisionChecker([Obstacle.table()])
    fingers = swept_gripper(Gripper(), 0.04, at(z=0.0123, rotation=DOWN), np.zeros(3))
    assert checker.nearest(fingers, within=0.0122) is None
    assert checker.nearest(fingers, within=0.0124).obstacle == "table"
    # Of one that stands askew, the box about it may be within the distance: that is not enough.
    askew = np.eye(4)
    askew[:3, :3] = Rotation.from_euler("y", 45.0, degrees=True).as_matrix()
    askew[:3, 3] = [0.07, 0.0, -0.06]
    checker = CollisionChecker([Obstacle.box("block", (0.1, 0.1, 0.1), askew)])
    assert 0.01 < checker.nearest(fingers).clearance < 0.05
    assert checker.nearest(fingers, within=0.01) is None


def test_without_obstacles_there_is_no_contact():
    assert nearest([], DOWN) is None
