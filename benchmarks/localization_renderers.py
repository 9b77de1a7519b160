"""Known objects judged in pictures of other makers: MuJoCo's renderer, and drawn solids.

The scenes of `localization` come from one ray caster. Here random solids, blocks, wedges and
channels stand alone, among others, partly hidden, or are replaced by solids that differ in some
sizes; one to three pictures are rendered by MuJoCo (OpenGL, shadow maps, gloss), or drawn as flat
polygons of random shades among random lines, polygons and discs, which differ from picture to
picture. Run alone by `python -m benchmarks.localization_renderers`.
"""

import argparse
import os
import sys
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

import smartview_jax as sv
from smartview_jax.cameras import OpenCV5
from smartview_jax.extras import import_extra
from smartview_jax.localization import localize
from smartview_jax.modeling import ObjectModel
from smartview_jax.simulation import Polyhedron, box, prism, random_polyhedron, roofed_block

from .hypotheses import pose_errors
from .localization_other_kinds import channel
from .localization_scenes import clutter, occluder, resting, similar_solids, viewpoints
from .localization_trials import is_right

KINDS = {"single": 0.2, "clutter": 0.25, "occluded": 0.25, "similar": 0.15, "absent": 0.15}
"""Shares of the kinds of scenes; in the last two the object is not there."""

SCENES = 40
"""Number of scenes of each maker."""

WIDTH, ROWS, FOCAL_LENGTH = 1280, 800, 1450.0
"""Size of the pictures and focal length, px."""

UNITS_PER_METRE = 20.0
"""Scale of MuJoCo's scenes: its shadow maps are made for objects of a metre."""

SUPERSAMPLING, SUBPIXEL_BITS = 3, 4
"""Drawn pixels in a pixel along each axis, and binary digits of the polygons' corners."""


class MadeScene(NamedTuple):
    """A scene before it is pictured.

    Attributes:
        model: of the object that is looked for.
        world_from_object: its pose; None where it is not there.
        solids: everything on the table.
        base_from_tool: poses of the camera.
        rng: state of the generator, for the pictures.
    """

    model: ObjectModel
    world_from_object: np.ndarray | None
    solids: list[Polyhedron]
    base_from_tool: np.ndarray
    rng: np.random.Generator


def calibration() -> sv.Calibration:
    """Return the camera of all scenes, a pinhole; tool and camera are one frame."""
    lens = OpenCV5(0.0, 0.0, 0.0, 0.0, 0.0)
    centre = 0.5 * (WIDTH - 1), 0.5 * (ROWS - 1)
    camera = sv.Camera(FOCAL_LENGTH, FOCAL_LENGTH, *centre, lens, (WIDTH, ROWS))
    return sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))


def random_solid(rng: np.random.Generator, convex: bool) -> Polyhedron:
    """Return a solid of 20 to 75 mm."""
    kind = rng.choice(["random", "box", "wedge"] + ([] if convex else ["roofed", "channel"]))
    if kind == "random":
        return random_polyhedron(rng, int(rng.choice([8, 10, 12])), rng.uniform(0.02, 0.03))
    if kind == "box":
        return box(*rng.uniform(0.02, 0.075, 3))
    if kind == "wedge":
        apex = [rng.uniform(-0.5, 0.3), rng.uniform(0.3, 0.8)]
        side = rng.uniform(0.03, 0.05)
        return prism(side * np.array([[-0.5, 0.0], [0.5, 0.0], apex]), rng.uniform(0.02, 0.05))
    if kind == "roofed":
        return roofed_block(rng.uniform(0.04, 0.06))
    return channel(rng.uniform(0.025, 0.035), rng.uniform(0.015, 0.025))


def made_scene(seed: int, convex: bool) -> MadeScene:
    """Return a scene; the same seed gives the same one. Convex solids can be drawn."""
    rng = np.random.default_rng((seed, 777))
    kind = rng.choice(list(KINDS), p=list(KINDS.values()))
    solid = random_solid(rng, convex)
    model, pose = solid.exact_model("object"), resting(solid, rng)
    placed = solid.moved(pose)
    middle = placed.vertices.mean(axis=0)
    poses = viewpoints(middle, rng, int(rng.choice([1, 2, 3], p=[0.3, 0.6, 0.1])))
    others = []
    if kind == "similar":
        others = similar_solids(solid, middle, rng)
    elif kind != "single":
        # Roofs are not convex.
        others = [other for other in clutter(placed, rng) if not convex or len(other.faces) == 6]
    if kind == "occluded":
        others.append(occluder(model, pose, poses, calibration(), rng, others))
    if kind in ("similar", "absent"):
        if kind == "absent":
            another = random_solid(rng, convex)
            others.append(another.moved(resting(another, rng)))
        return MadeScene(model, None, others, poses, rng)
    return MadeScene(model, pose, [placed, *others], poses, rng)


def mujoco_pictures(scene: MadeScene) -> list[np.ndarray]:
    """Return the pictures of a scene by MuJoCo's renderer, without a display."""
    os.environ.setdefault("MUJOCO_GL", "egl")
    mujoco = import_extra("mujoco", "cell", "pictures by MuJoCo")
    model = mujoco.MjModel.from_xml_string(_mujoco_xml(scene))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    blur, noise = scene.rng.uniform(0.3, 1.0), scene.rng.uniform(0.5, 3.0)
    pictures = []
    with mujoco.Renderer(model, ROWS, WIDTH) as renderer:
        for k in range(len(scene.base_from_tool)):
            renderer.update_scene(data, camera=f"view{k}")
            grey = cv2.cvtColor(renderer.render(), cv2.COLOR_RGB2GRAY)
            pictures.append(_sensed(grey, blur, noise, scene.rng))
    return pictures


def _mujoco_xml(scene: MadeScene) -> str:
    """Return a scene in MuJoCo's format, with random materials and lights."""
    rng, assets, parts = scene.rng, [], []
    for k, solid in enumerate(scene.solids):
        corners = UNITS_PER_METRE * solid.vertices[solid.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        # Each triangle has corners and normals of its own: shared ones are shaded as if round.
        assets.append(
            f'<mesh name="mesh{k}" inertia="shell" vertex="{_numbers(corners)}" '
            f'normal="{_numbers(np.repeat(normals, 3, axis=0))}" '
            f'face="{_numbers(np.arange(3 * len(corners)))}"/>'
            f'<material name="paint{k}" rgba="{_numbers(rng.uniform(0.25, 0.95, 3))} 1" '
            f'specular="{rng.uniform(0.0, 0.5)}" shininess="{rng.uniform(0.1, 0.8)}"/>'
        )
        parts.append(
            f'<geom type="mesh" mesh="mesh{k}" material="paint{k}" contype="0" conaffinity="0"/>'
        )
    for k, pose in enumerate(scene.base_from_tool):
        # MuJoCo's cameras look along -z, with y upwards.
        x, y, z, w = Rotation.from_matrix(pose[:3, :3] @ np.diag([1.0, -1.0, -1.0])).as_quat()
        angle = np.degrees(2.0 * np.arctan(0.5 * ROWS / FOCAL_LENGTH))
        parts.append(
            f'<camera name="view{k}" pos="{_numbers(UNITS_PER_METRE * pose[:3, 3])}" '
            f'quat="{w} {x} {y} {z}" fovy="{angle}"/>'
        )
    for shadow, strength in (("true", rng.uniform(0.4, 0.7)), ("false", rng.uniform(0.1, 0.3))):
        parts.append(
            f'<light directional="true" castshadow="{shadow}" pos="0 0 6" '
            f'dir="{_numbers(rng.uniform(-0.8, 0.8, 2))} -1" diffuse="{_numbers([strength] * 3)}"/>'
        )
    shades = [_numbers([shade] * 3) for shade in rng.uniform([0.2, 0.5], [0.4, 0.7])]
    assets.append(
        f'<texture name="squares" type="2d" builtin="{rng.choice(["flat", "checker"])}" '
        f'rgb1="{shades[0]}" rgb2="{shades[1]}" width="512" height="512"/>'
        f'<material name="table" texture="squares" texrepeat="{_numbers(rng.uniform(2, 12, 2))}"/>'
    )
    return f"""<mujoco><statistic extent="8" center="0 0 0"/><visual>
      <global offwidth="{WIDTH}" offheight="{ROWS}"/><map znear="0.1" zfar="20"/>
      <quality shadowsize="4096" offsamples="8"/></visual><asset>{"".join(assets)}</asset>
      <worldbody><geom type="plane" size="10 10 .01" material="table"/>{"".join(parts)}
      </worldbody></mujoco>"""


def _numbers(values: np.ndarray | list[float]) -> str:
    """Return numbers as MuJoCo reads them."""
    return " ".join(f"{value:.9g}" for value in np.ravel(values))


def drawn_pictures(scene: MadeScene) -> list[np.ndarray]:
    """Return the pictures of convex solids as polygons of random shades, the farthest first."""
    rng = scene.rng
    shades = [rng.uniform(50.0, 230.0, len(solid.faces)) for solid in scene.solids]
    ground, things = rng.uniform(60.0, 180.0), int(rng.integers(5, 40))
    blur, noise = rng.uniform(0.5, 1.5), rng.uniform(0.5, 5.0)
    pictures = []
    for pose in scene.base_from_tool:
        canvas = np.full((SUPERSAMPLING * ROWS, SUPERSAMPLING * WIDTH), ground, np.float32)
        for _ in range(things):
            _fill(canvas, _random_outline(rng), rng.uniform(20.0, 240.0))
        order = np.argsort(
            [-np.linalg.norm(s.vertices.mean(axis=0) - pose[:3, 3]) for s in scene.solids]
        )
        for k in order:
            _draw(canvas, scene.solids[k], shades[k], pose)
        grey = cv2.resize(canvas, (WIDTH, ROWS), interpolation=cv2.INTER_AREA)
        pictures.append(_sensed(grey, blur, noise, rng))
    return pictures


def _random_outline(rng: np.random.Generator) -> np.ndarray:
    """Return the outline of a bar, a polygon or a disc somewhere in the picture, px."""
    middle, kind = rng.uniform([0, 0], [WIDTH, ROWS]), rng.integers(3)
    if kind == 0:
        length, width, angle = rng.uniform([30, 1, 0], [400, 6, np.pi])
        corners = 0.5 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length, width]
        c, s = np.cos(angle), np.sin(angle)
        return middle + corners @ np.array([[c, s], [-s, c]])
    count = int(rng.integers(3, 6)) if kind == 1 else 40
    angles = np.sort(rng.uniform(0.0, 2.0 * np.pi, count)) if kind == 1 else np.linspace(0, 6.2, 40)
    return middle + rng.uniform(10, 100) * np.column_stack([np.cos(angles), np.sin(angles)])


def _draw(canvas: np.ndarray, solid: Polyhedron, shades: np.ndarray, pose: np.ndarray) -> None:
    """Draw the faces of a convex solid that face the camera."""
    x, y, z = np.linalg.inv(pose)[:3] @ np.pad(
        solid.vertices.T, ((0, 1), (0, 0)), constant_values=1
    )
    pixels = FOCAL_LENGTH * np.column_stack([x / z, y / z]) + 0.5 * np.array([WIDTH - 1, ROWS - 1])
    for face, shade in zip(solid.faces, shades, strict=True):
        a, b, c = solid.vertices[list(face[:3])]
        if np.cross(b - a, c - a) @ (pose[:3, 3] - a) > 0.0:
            _fill(canvas, pixels[list(face)], shade)


def _fill(canvas: np.ndarray, outline: np.ndarray, shade: float) -> None:
    """Fill an outline, px, on the enlarged canvas."""
    enlarged = SUPERSAMPLING * (outline + 0.5) - 0.5
    corners = np.rint(enlarged * 2**SUBPIXEL_BITS).astype(np.int32)
    cv2.fillPoly(canvas, [corners], float(shade), shift=SUBPIXEL_BITS)


def _sensed(grey: np.ndarray, blur: float, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Return a picture as a sensor sees it: blurred, with noise, in whole grey levels."""
    blurred = cv2.GaussianBlur(grey.astype(float), (0, 0), blur)
    return np.clip(np.rint(blurred + rng.normal(0.0, noise, grey.shape)), 0, 255).astype(np.uint8)


MAKERS: dict[str, tuple[Callable[[MadeScene], list[np.ndarray]], bool]] = {
    "mujoco": (mujoco_pictures, False),
    "drawn": (drawn_pictures, True),
}
"""How a scene is pictured, and whether its solids have to be convex."""


def print_renderers(count: int = SCENES, makers: list[str] | None = None) -> bool:
    """Print what is found in the pictures of each maker; True where no accepted pose is wrong."""
    print(f"\n{'maker':10}{'pictures':>9}{'scenes':>8}{'objects':>9}{'found':>7}{'wrong':>7}")
    good = True
    for maker in makers or list(MAKERS):
        pictured, convex = MAKERS[maker]
        counts: dict[bool, np.ndarray] = {True: np.zeros(4, int), False: np.zeros(4, int)}
        for seed in range(count):
            scene = made_scene(seed, convex)
            pictures = pictured(scene)
            counts[len(pictures) == 1] += [1, *_found(scene, pictures)]
        for is_single, numbers in counts.items():
            scenes, objects, found, wrong = numbers
            views = "one" if is_single else "more"
            print(f"{maker:10}{views:>9}{scenes:8}{objects:9}{found:7}{wrong:7}")
            good &= is_single or wrong == 0
    return good


def _found(scene: MadeScene, pictures: list[np.ndarray]) -> tuple[int, int, int]:
    """Return the numbers of objects, of right accepted poses, and of wrong ones."""
    localizations = localize(pictures, scene.base_from_tool, calibration(), scene.model).accepted
    truth = scene.world_from_object
    if truth is None:
        return 0, 0, len(localizations)
    errors = [pose_errors(scene.model, obj.world_from_object[None], truth) for obj in localizations]
    right = sum(is_right(float(angle[0]), float(shift[0])) for angle, shift in errors)
    return 1, right, len(localizations) - right


def main() -> int:
    parser = argparse.ArgumentParser(description="Known objects in pictures of other makers.")
    parser.add_argument("--makers", nargs="*", choices=[*MAKERS], default=[*MAKERS])
    parser.add_argument("--scenes", type=int, default=SCENES, help="number of scenes of each maker")
    arguments = parser.parse_args()
    return 0 if print_renderers(arguments.scenes, arguments.makers) else 1


if __name__ == "__main__":
    sys.exit(main())
