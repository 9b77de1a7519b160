"""Models and pictures of the real sets for localisation, with reference poses of others.

Vertices of the castle and the cubes are their CAD; the house is modelled from three of its views,
and looked for in two others.
"""

import csv
import dataclasses
import json
from typing import NamedTuple

import numpy as np

import smartview_jax as sv
from smartview_jax.modeling import Face, ObjectModel, face_plane, find_symmetry, triangulate_points

from .object_features import HOUSE_VIEWS, reference_pictures
from .real_sets import SHARED

CASTLE_PAIRS = ((1, 20), (5, 25), (10, 40), (3, 16), (8, 30), (12, 36))
"""Numbers of the castle's pictures that are taken as two views; the first three are in NOTES.md."""

HOUSE_UNIT = 20.0
"""The house is some 3.5 units long and was 0.2 m or so."""

HOUSE_MODEL_VIEWS, HOUSE_TEST_VIEWS = (0, 2, 4), (1, 3)


class RealCase(NamedTuple):
    """Pictures in which an object is to be found.

    Attributes:
        name: of set, object and pictures.
        calibration: one camera for all views, with identity hand-eye.
        poses: `world_from_camera`, in the place of `base_from_tool`.
        pictures: grey.
        model: of the object.
        world_from_object: reference pose.
        unit: length of the set's unit, if a metre is one: some objects are in units of their own.
    """

    name: str
    calibration: sv.Calibration
    poses: np.ndarray
    pictures: list[np.ndarray]
    model: ObjectModel
    world_from_object: np.ndarray
    unit: float = 1.0


def real_cases() -> list[RealCase]:
    """Return all cases whose set lies next to this checkout."""
    makers = {"visp_castle_simu": castle_cases, "visp_cube": cube_cases, "vgg_house": house_cases}
    return [case for name, make in makers.items() if (SHARED / name).is_dir() for case in make()]


def castle_cases() -> list[RealCase]:
    """Return the cube and the tower of the rendered castle, each in several pairs of views."""
    content = json.loads((SHARED / "visp_castle_simu" / "object.json").read_text(encoding="utf-8"))
    # The file lacks back and bottom of the cube; with them it has a cube's symmetry.
    content["faces"] += [[18, 20, 21, 19], [14, 20, 18, 15]]
    content["edges"] += [[18, 20]]
    cube = _part(content, list(range(14, 22)), {22: 19, 23: 21}, "cube")
    # The tower is square to within 3 mm, which is as good as its vertices are known.
    tower = _part(content, list(range(6, 14)), {}, "tower", tolerance=4e-3)
    cases = []
    for pair in CASTLE_PAIRS:
        views = [f"Image_{k:04}" for k in pair]
        data = reference_pictures("visp_castle_simu", "vertex", "camera_from_world", views, {})
        for model in (cube, tower):
            name = f"castle {model.name} {pair}"
            cases.append(
                RealCase(name, data.calibration, data.poses, data.pictures, model, np.eye(4))
            )
    return cases


def cube_cases() -> list[RealCase]:
    """Return the cube before a fixed camera: one picture each, the reference pose moves."""
    content = json.loads((SHARED / "visp_cube" / "object.json").read_text(encoding="utf-8"))
    model = _part(content, list(range(8)), {}, "cube")
    data = reference_pictures("visp_cube", "vertex", "camera_from_object_reference", None, {})
    return [
        RealCase(
            f"cube picture {k}",
            data.calibration,
            np.eye(4)[None],
            [picture],
            model,
            np.linalg.inv(pose),
        )
        for k, (picture, pose) in enumerate(zip(data.pictures, data.poses, strict=True))
    ]


def house_cases() -> list[RealCase]:
    """Return the details of the house's front, modelled from some views and found in others."""
    folder = SHARED / "vgg_house"
    content = json.loads((folder / "wireframe.json").read_text(encoding="utf-8"))
    data = reference_pictures("vgg_house", "point", "camera_from_world", HOUSE_VIEWS, {})
    cameras = json.loads((folder / "cameras.json").read_text(encoding="utf-8"))["cameras"]
    common = np.array(cameras[0]["K"], dtype=float)
    common[0, 1] = 0.0
    pixels = np.full((len(HOUSE_VIEWS), len(content["vertices"]), 2), np.nan)
    for row in csv.DictReader((folder / "clicks.csv").read_text(encoding="utf-8").splitlines()):
        if row["view"] in HOUSE_VIEWS:
            view = HOUSE_VIEWS.index(row["view"])
            # Into the common camera, as the pictures.
            change = common @ np.linalg.inv(np.array(cameras[view]["K"], dtype=float))
            place = change @ [float(row["u"]), float(row["v"]), 1.0]
            pixels[view, int(row["vertex"])] = place[:2]
    own = list(HOUSE_MODEL_VIEWS)
    points = triangulate_points(data.calibration, data.poses[own], pixels[own]).points
    known = np.flatnonzero(np.isfinite(points).all(axis=1))
    edges = [edge for edge in content["edges"] if set(edge) <= set(known.tolist())]
    used = sorted({vertex for edge in edges for vertex in edge})
    number = {vertex: k for k, vertex in enumerate(used)}
    model = ObjectModel(
        points[used], np.array([[number[a], number[b]] for a, b in edges]), name="house"
    )
    model = dataclasses.replace(model, symmetry=find_symmetry(model))
    test = list(HOUSE_TEST_VIEWS)
    cases = [("two views", test), *((f"view {k}", [k]) for k in test)]
    return [
        RealCase(
            f"house {name}",
            data.calibration,
            data.poses[views],
            [data.pictures[k] for k in views],
            model,
            np.eye(4),
            HOUSE_UNIT,
        )
        for name, views in cases
    ]


def _part(
    content: dict,
    vertices: list[int],
    same: dict[int, int],
    name: str,
    tolerance: float | None = None,
) -> ObjectModel:
    """Return the model of some vertices of a file, with outward faces and its symmetry."""
    number = {vertex: k for k, vertex in enumerate(vertices)}
    number.update({other: number[vertex] for other, vertex in same.items()})
    points = np.array(content["vertices"], dtype=float)[vertices]
    edges = {
        tuple(sorted((number[a], number[b])))
        for a, b in content["edges"]
        if a in number and b in number
    }
    faces = []
    for loop in content["faces"]:
        if all(vertex in number for vertex in loop):
            face = Face(tuple(dict.fromkeys(number[vertex] for vertex in loop)))
            plane = face_plane(points, face)
            inward = (plane.origin - points.mean(axis=0)) @ plane.normal < 0.0
            faces.append(face.reversed if inward else face)
    model = ObjectModel(points, np.array(sorted(edges)), tuple(faces), name=name)
    return ObjectModel(
        points, model.edges, model.faces, name=name, symmetry=find_symmetry(model, tolerance)
    )
