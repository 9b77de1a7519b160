"""Real and rendered pictures of objects: reprojection and distance from reference points.

Each is compared with a plain bundle adjustment of the points by SciPy on the same correspondences
with the same cameras. The anchors are from the sets' NOTES.md. In visp_cube only the object moved,
and its poses come from the same edges: its figures show that the program agrees with itself.
"""

import csv
import json
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import coo_matrix

import smartview_jax as sv
from smartview_jax.modeling import triangulate_points

from .real_sets import SHARED

AS_GOOD = 1e-3
"""The share by which a figure may be larger than SciPy's, whose steps end at a tolerance."""


class ObjectSet(NamedTuple):
    """Pictures of an object with known cameras, as arrays.

    Attributes:
        K: intrinsics of every view, with skew.
        camera_from_world: extrinsics of every view.
        pixels: corners, NaN where not seen.
        reference: points that somebody else gave.
        size: width and height, px.
    """

    K: np.ndarray
    camera_from_world: np.ndarray
    pixels: np.ndarray
    reference: np.ndarray
    size: tuple[int, int]

    def of(self, points: np.ndarray) -> "ObjectSet":
        """The set with some of its points only."""
        return self._replace(pixels=self.pixels[:, points], reference=self.reference[points])


class Row(NamedTuple):
    """A set, how its answer is judged, and its anchors.

    Attributes:
        name: what is printed.
        load: the set; None where it is not next to the checkout.
        distance: figure of the distances from the reference, and its name.
        rms_anchor: reprojection RMS in NOTES.md, px; infinite where there is none.
        distance_anchor: distance in NOTES.md, in the reference's unit; infinite if none.
    """

    name: str
    load: Callable[[], ObjectSet]
    distance: Callable[[np.ndarray], float]
    unit: str
    rms_anchor: float
    distance_anchor: float


def read_set(
    folder: str, feature: str, pose: str, reference: np.ndarray, views: list[str] | None
) -> ObjectSet:
    """The corners of some views of a set."""
    content = json.loads((SHARED / folder / "cameras.json").read_text(encoding="utf-8"))
    cameras = {one["view"]: one for one in content["cameras"]}
    chosen = list(cameras) if views is None else views
    with (SHARED / folder / "corners.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    pixels = np.full((len(chosen), len(reference), 2), np.nan)
    for row in rows:
        if row["view"] in chosen:
            place = chosen.index(row["view"]), int(row[feature])
            pixels[place] = float(row["u"]), float(row["v"])
    K = np.array([cameras[view]["K"] for view in chosen], dtype=float)
    poses = np.array([cameras[view][pose] for view in chosen], dtype=float)
    return ObjectSet(K, poses, pixels, reference, (content["width"], content["height"]))


def vgg_house() -> ObjectSet:
    """The model house: points that two of the five pictures see."""
    path = SHARED / "vgg_house" / "points.csv"
    reference = np.loadtxt(path, delimiter=",", skiprows=1)[:, 1:]
    views = [f"{k:03}" for k in range(5)]
    return _seen_by(read_set("vgg_house", "point", "camera_from_world", reference, views), 2)


def castle() -> ObjectSet:
    """The rendered castle: vertices that agree with the pictures, seen by four of six views."""
    content = json.loads((SHARED / "visp_castle_simu" / "object.json").read_text(encoding="utf-8"))
    views = [f"Image_{k:04}" for k in (1, 8, 16, 24, 32, 40)]
    loaded = read_set("visp_castle_simu", "vertex", "camera_from_world",
                     np.array(content["vertices"]), views)  # fmt: skip
    return _seen_by(loaded.of(np.array(content["trusted_vertices"])), 4)


def cube() -> ObjectSet:
    """The cube, its pictures placed by poses that were fitted to its own edges."""
    content = json.loads((SHARED / "visp_cube" / "object.json").read_text(encoding="utf-8"))
    reference = np.array(content["vertices"])
    return _seen_by(
        read_set("visp_cube", "vertex", "camera_from_object_reference", reference, None), 2
    )


def _seen_by(found: ObjectSet, views: int) -> ObjectSet:
    return found.of(np.flatnonzero(np.isfinite(found.pixels[..., 0]).sum(axis=0) >= views))


ROWS = (
    Row("vgg_house", vgg_house, lambda d: float(np.median(d)), "median", 0.395, 1.1e-4),
    Row("visp_castle_simu", castle, lambda d: float(1e3 * np.sqrt(np.mean(d**2))), "mm RMS",
        np.inf, 0.26),
    Row("visp_cube", cube, lambda d: float(1e3 * np.sqrt(np.mean(d**2))), "mm RMS", np.inf, np.inf),
)  # fmt: skip


def run_real() -> bool:
    """Print the table; True where every figure is as good as SciPy's and as the anchors."""
    print(f"\n{'set':18}{'points':>7}{'px RMS':>9}{'SciPy':>9}{'anchor':>8}"
          f"{'distance':>11}{'SciPy':>10}{'anchor':>9}  unit")  # fmt: skip
    good = True
    for row in ROWS:
        if not (SHARED / row.name).is_dir():
            print(f"{row.name:18}skipped: it is not next to this checkout (shared/data)")
            continue
        data = row.load()
        answers = [ours(data), scipys(data)]
        rms = [pixel_rms(data, points) for points in answers]
        away = [row.distance(np.linalg.norm(p - data.reference, axis=1)) for p in answers]
        within = (
            rms[0] <= rms[1] * (1.0 + AS_GOOD)
            and away[0] <= away[1] * (1.0 + 10.0 * AS_GOOD)
            and rms[0] <= 1.02 * row.rms_anchor
            and away[0] <= 1.05 * row.distance_anchor
        )
        good = good and within
        print(f"{row.name:18}{len(data.reference):7}{rms[0]:9.4f}{rms[1]:9.4f}{row.rms_anchor:8.3g}"
              f"{away[0]:11.3g}{away[1]:10.3g}{row.distance_anchor:9.3g}  {row.unit}"
              f"{'' if within else '  WORSE'}")  # fmt: skip
    return good


def ours(data: ObjectSet) -> np.ndarray:
    """The points of `triangulate_points`.

    The cameras of a view differ in focal length and skew. So pixels are taken to one pinhole camera
    together with their covariance, which keeps the weights that they have in their own picture.
    """
    focal, width = 1000.0, 4000
    common = np.array([[focal, 0.0, width / 2], [0.0, focal, width / 2], [0.0, 0.0, 1.0]])
    homography = common @ np.linalg.inv(data.K)
    pixels = np.einsum("vij,vpj->vpi", homography[:, :2, :2], data.pixels)
    pixels += homography[:, None, :2, 2]
    covariance = homography[:, :2, :2] @ homography[:, :2, :2].swapaxes(1, 2)
    camera = sv.Camera(focal, focal, width / 2, width / 2, sv.cameras.Pinhole(), (width, width))
    calibration = sv.Calibration.eye_in_hand(camera, np.eye(4), np.eye(4))
    triangulated = triangulate_points(
        calibration,
        np.linalg.inv(data.camera_from_world),
        pixels,
        pixel_sigma=np.repeat(covariance[:, None], pixels.shape[1], axis=1),
    )
    if triangulated.failures:
        print(f"not triangulated: {triangulated.failures}")
    return triangulated.points


def project(data: ObjectSet, points: np.ndarray) -> np.ndarray:
    """Pixels of points by each view's own camera."""
    pose = data.camera_from_world
    rays = np.einsum("vij,pj->vpi", pose[:, :3, :3], points) + pose[:, None, :3, 3]
    pixels = np.einsum("vij,vpj->vpi", data.K, rays)
    return pixels[..., :2] / pixels[..., 2:]


def pixel_rms(data: ObjectSet, points: np.ndarray) -> float:
    """RMS distance of measured from predicted corners, px."""
    return float(np.sqrt(np.nanmean(np.sum((project(data, points) - data.pixels) ** 2, axis=-1))))


def scipys(data: ObjectSet) -> np.ndarray:
    """The points of a plain bundle adjustment from the linear solution."""
    start = linear_points(data)
    seen = np.isfinite(data.pixels[..., 0])
    index = np.broadcast_to(np.arange(seen.shape[1]), seen.shape)[seen]
    rows = np.arange(2 * len(index)).repeat(3)
    columns = (3 * index.repeat(2)[:, None] + np.arange(3)).ravel()
    structure = coo_matrix((np.ones(len(rows)), (rows, columns)))

    def residuals(flat: np.ndarray) -> np.ndarray:
        return (project(data, flat.reshape(-1, 3)) - data.pixels)[seen].ravel()

    best = least_squares(residuals, start.ravel(), jac_sparsity=structure, x_scale="jac",
                         xtol=1e-12, ftol=1e-12, gtol=1e-12)  # fmt: skip
    return best.x.reshape(-1, 3)


def linear_points(data: ObjectSet) -> np.ndarray:
    """The direct linear transform: the null vector of u P_3 - P_1, v P_3 - P_2."""
    P = data.K @ data.camera_from_world[:, :3]
    points = []
    for k in range(data.pixels.shape[1]):
        views = np.isfinite(data.pixels[:, k, 0])
        z = data.pixels[views, k]
        rows = (z[..., None] * P[views, 2][:, None] - P[views, :2]).reshape(-1, 4)
        null = np.linalg.svd(rows)[2][-1]
        points.append(null[:3] / null[3])
    return np.array(points)
