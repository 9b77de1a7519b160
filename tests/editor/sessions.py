"""Sessions of the editor on the drawn house, and clicks on its vertices."""

import numpy as np

from smartview_jax.editor import ModelSession


def open_session(scene, path=None, **given):
    return ModelSession(scene.calibration, scene.base_from_tool, scene.pictures, path=path, **given)


def click_all(session, scene, views=(0, 1, 3), seed=0, vertices=None):
    """Click every vertex, or those that are given, in some views; return the ids."""
    rng = np.random.default_rng(seed)
    ids = []
    for vertex in range(len(scene.truth.vertices)) if vertices is None else vertices:
        point = None
        for view in views:
            pixel = scene.click(view, vertex, rng)
            point = session.click(session.names[view], pixel, point)
        ids.append(point)
    return ids


def drawn_house(session, scene):
    """All points and faces of the house."""
    ids = click_all(session, scene)
    for face in scene.truth.faces:
        session.add_face([ids[vertex] for vertex in face.loop])
    return ids


def say(session, kind, *items, **given):
    change = {"do": "add_constraint", "kind": kind, "items": [list(group) for group in items]}
    session.change({**change, **given})
