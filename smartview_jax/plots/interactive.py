"""Show cameras and target in a scene that a reader can turn with the mouse, without a network.

The scene is drawn by plotly.js (its three-dimensional part, from the npm package), which is
included in the page.
"""

import json
from collections.abc import Sequence
from importlib.resources import files
from typing import Any

import numpy as np

from ..calibration import Calibration
from ..dataset import Dataset
from ..files import finite_or_null
from .camera_scene import CameraScene, camera_scene
from .figures import BLUE, GREEN, GREY, RED

_SCRIPT = "vendor/plotly-gl3d.min.js"

SCENE_HEIGHT = 620
"""Height of the scene in the page, CSS px."""


class InteractiveScene:
    """Cameras and target in space, shown in a notebook or a page as an interactive scene.

    Attributes:
        traces: the content, in plotly.js's format.
        layout: axes and background, in plotly.js's format.
    """

    def __init__(self, traces: list[dict[str, Any]], layout: dict[str, Any]):
        """Store the description of the scene."""
        self.traces: list[dict[str, Any]] = traces
        self.layout: dict[str, Any] = layout

    def html(self, element_id: str = "scene") -> str:
        """Return the scene as part of a page, with its program and its own element id."""
        script = files("smartview_jax.plots").joinpath(_SCRIPT).read_text(encoding="utf-8")
        # In a name, `</script>` would end the script and `<!--<script>` would swallow the rest of
        # the page; JSON reads the escaped form as the same text.
        description = json.dumps([self.traces, self.layout], allow_nan=False)
        description = description.replace("<", "\\u003c")
        return (
            f'<div id="{element_id}" style="width:100%;height:{SCENE_HEIGHT}px"></div>\n'
            f"<script>{script}</script>\n"
            f'<script>Plotly.newPlot("{element_id}", ...{description}, '
            "{responsive: true, displaylogo: false, scrollZoom: true});</script>"
        )

    def __repr__(self) -> str:
        return f"<scene of {', '.join(t['name'] for t in self.traces if t['mode'] == 'markers')}>"

    def _repr_html_(self) -> str:
        return self.html(f"scene-{id(self)}")


def interactive_cameras(
    data: Dataset,
    calibration: Calibration,
    rms_per_view: Sequence[float] | np.ndarray | None = None,
) -> InteractiveScene:
    """Return cameras and target in the target's frame, mm, with each view's RMS, px, as a scene."""
    scene = camera_scene(data, calibration)
    texts = list(scene.view_ids)
    if rms_per_view is not None:
        texts = [
            f"view {name}<br>{rms:.2f} px RMS" if np.isfinite(rms) else f"view {name}<br>not used"
            for name, rms in zip(scene.view_ids, rms_per_view, strict=True)
        ]
    # The target has no texts, because its points would cover the cameras' texts.
    traces = [_points("target", scene.target, GREY, 2.0)]
    for name, chosen, colour in (
        ("cameras", scene.used, BLUE),
        ("cameras of views not used", ~scene.used, RED),
    ):
        if chosen.any():
            views = np.flatnonzero(chosen)
            traces.append(_pyramids(scene, views, colour))
            traces.append(
                _points(name, scene.centres[views], colour, 4.0, [texts[k] for k in views])
            )
    for letter, axis, colour in zip("xyz", np.eye(3), (RED, GREEN, BLUE), strict=True):
        line = np.stack([np.zeros(3), scene.axis_length * axis])
        traces.append(_lines(f"{letter} of the target", line, colour, 5.0))
    return InteractiveScene(traces, _layout(scene))


def _coordinates(points: np.ndarray) -> dict[str, list[float | None]]:
    """Return points in mm as plotly.js takes them, to 0.01 mm; NaN ends a line."""
    # More digits would enlarge the page without a visible difference.
    millimetres = np.round(1e3 * points, 2)
    return {
        name: list(map(finite_or_null, column))
        for name, column in zip("xyz", millimetres.T, strict=True)
    }


def _points(
    name: str, points: np.ndarray, colour: str, size: float, texts: Sequence[str] | None = None
) -> dict[str, Any]:
    """Return a trace of points, with a text each where the mouse points."""
    hover = {"hoverinfo": "skip"} if texts is None else {"text": list(texts), "hoverinfo": "text"}
    marker = {"size": size, "color": colour}
    trace = {"type": "scatter3d", "mode": "markers", "name": name, "marker": marker}
    return trace | hover | _coordinates(points)


def _lines(name: str, points: np.ndarray, colour: str, width: float) -> dict[str, Any]:
    """Return a trace of lines through points; NaN ends a line."""
    line = {"color": colour, "width": width}
    trace = {"type": "scatter3d", "mode": "lines", "name": name, "line": line}
    return trace | {"hoverinfo": "skip", "showlegend": False} | _coordinates(points)


def _pyramids(scene: CameraScene, views: np.ndarray, colour: str) -> dict[str, Any]:
    """Return a trace of the pyramids of some cameras."""
    pieces = []
    for view in views:
        centre, (a, b, c, d) = scene.centres[view], scene.corners[view]
        # One stroke along every edge: the picture's border, then to the centre and back.
        pieces += [a, b, c, d, a, centre, b, c, centre, d, np.full(3, np.nan)]
    return _lines("cameras", np.array(pieces), colour, 2.0)


def _layout(scene: CameraScene) -> dict[str, Any]:
    """Return the axes, which share one scale, and the initial viewpoint."""
    # The cameras are drawn on top, also where the target's z points away from them.
    up = -1.0 if scene.camera_side_is_below else 1.0
    axes = {f"{name}axis": {"title": {"text": f"{name} (mm)"}} for name in "xyz"}
    view = {
        "up": {"x": 0.0, "y": 0.0, "z": up},
        "eye": {"x": 1.2, "y": 1.2 * up, "z": 0.7 * up},
    }
    return {
        # With a turntable z would always point upwards.
        "scene": axes | {"aspectmode": "data", "camera": view, "dragmode": "orbit"},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": {"x": 0.0, "y": 1.0},
    }
