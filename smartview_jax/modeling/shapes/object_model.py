"""Hold a wireframe model of an object with its surfaces, grasps, symmetry and uncertainty.

The frame `object` is the model's own, in metres; a person places it, by default on a face with z
along the outward normal. world_from_object, the paper's H_World^Object, is its pose.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from ...argument_checks import errors_at, require_readable_or_empty
from .dimensions import pair_lengths
from .faces import (
    PLANAR_TOLERANCE,
    Face,
    FacePlane,
    check_face,
    face_plane,
    with_oriented_holes,
)
from .grasp_frames import Grasp
from .symmetry import Symmetry

MAX_EXTENT = 10.0
"""Largest extent of an object, m, as large as the reach of any arm.

A larger one is in another unit: a part of 11 mm whose millimetres are taken for metres.
"""

MAX_RELATIVE_TOLERANCE = 0.1
"""Largest tolerance of a model over its extent."""


@dataclasses.dataclass(frozen=True, eq=False)
class ObjectModel:
    """A model of an object: vertices, edges, faces, grasps; checked when it is made.

    The covariance of the vertices has two parts. `covariance` holds the pictures' noise. The
    calibration's error is common to all vertices; it is kept as a Jacobian, so that an error that
    moves the object as a whole does not affect distances within it:

        covariance of all coordinates = covariance + calibration_factor @ calibration_factor.T

    Attributes:
        vertices: in the object's frame, m.
        edges: pairs of vertices, the wireframe.
        faces: flat surfaces, normals outward.
        covariance: the pictures' part, m^2: of every vertex, `(V, 3, 3)`, or of all coordinates
            together, `(3V, 3V)`; None if the vertices are exact, as in CAD.
        calibration_factor: movement of all coordinates for one standard deviation of each
            independent error of the calibration, `(3V, errors)`, m; None if the calibration was
            taken as exact.
        grasps: poses of the gripper on faces.
        symmetry: rotations that map the object onto itself; None if it was not computed.
        name: for people.
        provenance: sentences on the origin of the model, the oldest first.
        planar_tolerance: largest distance of a vertex from the plane of its face, over the extent
            of the face.
        tolerance: standard deviation of the object's edges from the model, m: how exactly such
            objects are made, and how much they bend. Zero for objects exactly like the model.

    For example:

        >>> corners = 1e-3 * np.array([[0.0, 0.0, 0.0], [60.0, 0.0, 0.0], [60.0, 40.0, 0.0]])
        >>> edges = np.array([[0, 1], [1, 2], [2, 0]])
        >>> card = sv.ObjectModel(corners, edges, (sv.modeling.Face((0, 1, 2)),), name="card")
        >>> card.vertices.max(axis=0).tolist()
        [0.06, 0.04, 0.0]
    """

    vertices: Float[np.ndarray, "V 3"]
    edges: Int[np.ndarray, "E 2"] = dataclasses.field(default_factory=lambda: np.zeros((0, 2), int))
    faces: tuple[Face, ...] = ()
    covariance: Float[np.ndarray, "_ ..."] | None = None
    calibration_factor: Float[np.ndarray, "_ _"] | None = None
    grasps: tuple[Grasp, ...] = ()
    symmetry: Symmetry | None = None
    name: str = ""
    provenance: tuple[str, ...] = ()
    planar_tolerance: float = PLANAR_TOLERANCE
    tolerance: float = 0.0

    def __post_init__(self) -> None:
        """Check all parts.

        Raises:
            ValueError: a coordinate that is not finite, an edge to a vertex that does not exist, a
                face that is not planar or crosses itself, a grasp on no face, a covariance that
                does not fit, a tolerance that is negative or as large as the object, a name that no
                file could hold; the message names the part.
        """
        require_readable_or_empty("object", self.name)
        self._check_vertices()
        # Millimetres given as metres.
        if not 0.0 <= self.tolerance <= MAX_RELATIVE_TOLERANCE * self.extent:
            raise ValueError(
                f"tolerance: expected metres, from 0 to {MAX_RELATIVE_TOLERANCE:.0%} of the "
                f"object's {self.extent:.4g} m; found {self.tolerance:.4g}"
            )
        self._check_edges()
        self._check_covariances()
        faces, sigma = [], self.vertex_sigma
        for k, face in enumerate(self.faces):
            with errors_at(f"face {k} ({face.name})" if face.name else f"face {k}"):
                check_face(self.vertices, face, sigma, self.planar_tolerance)
            faces.append(with_oriented_holes(self.vertices, face))
        # The class is frozen, but the orientation of holes is corrected before anyone uses the
        # model.
        object.__setattr__(self, "faces", tuple(faces))
        for grasp in self.grasps:
            if not 0 <= grasp.face < len(self.faces):
                raise ValueError(f"grasp {grasp.name!r} is on face {grasp.face}, which is missing")

    def _check_vertices(self) -> None:
        """Raise an error for coordinates that are not finite or not in metres."""
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3:
            raise ValueError(f"vertices: expected shape (V, 3), found {self.vertices.shape}")
        wrong = np.flatnonzero(~np.isfinite(self.vertices).all(axis=1))
        if len(wrong):
            raise ValueError(
                f"vertex {wrong[0]}: not finite: {self.vertices[wrong[0]].round(6).tolist()}"
            )
        # Millimetres given as metres would turn a bracket into a house.
        if self.extent > MAX_EXTENT:
            raise ValueError(
                f"vertices: an object of {self.extent:.4g} m; expected metres, up to "
                f"{MAX_EXTENT:g} m"
            )

    def _check_edges(self) -> None:
        """Raise an error for an edge to nowhere, from a vertex to itself, or given twice."""
        known: set[frozenset[int]] = set()
        for k, (a, b) in enumerate(self.edges.tolist()):
            for index in (a, b):
                if not 0 <= index < len(self.vertices):
                    raise ValueError(
                        f"edge {k} {(a, b)} leads to vertex {index}, which does not exist: the "
                        f"model has {len(self.vertices)} vertices, from 0"
                    )
            if a == b:
                raise ValueError(f"edge {k} leads from vertex {a} to itself")
            # Edges have no direction.
            if frozenset((a, b)) in known:
                raise ValueError(f"edge {k} {(a, b)} is listed twice")
            known.add(frozenset((a, b)))

    def _check_covariances(self) -> None:
        """Raise an error for covariances of another size, not finite or not symmetric."""
        count = len(self.vertices)
        covariance, factor = self.covariance, self.calibration_factor
        if covariance is not None:
            if covariance.shape not in ((count, 3, 3), (3 * count, 3 * count)):
                raise ValueError(
                    f"covariance: expected shape {(count, 3, 3)} or {(3 * count, 3 * count)}, "
                    f"found {covariance.shape}"
                )
            if not np.isfinite(covariance).all() or not np.allclose(
                covariance, covariance.swapaxes(-1, -2)
            ):
                raise ValueError("covariance: expected finite symmetric matrices")
        if factor is not None and (
            factor.ndim != 2 or len(factor) != 3 * count or not np.isfinite(factor).all()
        ):
            raise ValueError(f"calibration_factor: expected {3 * count} finite rows")

    @property
    def extent(self) -> float:
        """The largest size along an axis of the object's frame, m; 0 without vertices."""
        return float(np.ptp(self.vertices, axis=0).max()) if len(self.vertices) else 0.0

    @property
    def object_from_object(self) -> Float[np.ndarray, "K 4 4"]:
        """The transforms that map the object onto itself, the identity first.

        Only the identity if no symmetry is known.
        """
        return np.eye(4)[None] if self.symmetry is None else self.symmetry.object_from_object

    @property
    def is_exact(self) -> bool:
        """Whether the vertices have no uncertainty, as in CAD."""
        return self.covariance is None and self.calibration_factor is None

    @property
    def vertex_covariances(self) -> Float[np.ndarray, "V 3 3"]:
        """The covariance of every vertex, pictures and calibration together, m^2."""
        count = len(self.vertices)
        # The 3 x 3 blocks on the diagonal of a matrix of all coordinates.
        rows = np.arange(3 * count).reshape(count, 3)
        blocks = np.zeros((count, 3, 3))
        if self.covariance is not None:
            full = self.covariance.ndim == 2
            blocks = (
                self.covariance[rows[:, :, None], rows[:, None, :]] if full else self.covariance
            )
        if self.calibration_factor is not None:
            factors = self.calibration_factor.reshape(count, 3, -1)
            blocks = blocks + factors @ factors.swapaxes(1, 2)
        return blocks

    @property
    def vertex_sigma(self) -> Float[np.ndarray, "V"] | None:
        """The standard deviation of every vertex in its worst direction, m; None if exact."""
        if self.is_exact:
            return None
        return np.sqrt(np.linalg.eigvalsh(self.vertex_covariances)[:, -1].clip(0.0))

    def distance(self, a: int, b: int) -> tuple[float, float]:
        """Return the distance of two vertices and its standard deviation, m.

        Errors of the calibration that move both vertices alike cancel.
        """
        (length,), (gradient,) = pair_lengths(self.vertices, [(a, b)])
        if length == 0.0:
            raise ValueError(f"vertices {a} and {b} are in one place")
        variance = 0.0
        if self.covariance is not None and self.covariance.ndim == 2:
            variance += gradient @ self.covariance @ gradient
        elif self.covariance is not None:
            by_vertex = gradient.reshape(-1, 3)
            variance += np.einsum("vi,vij,vj->", by_vertex, self.covariance, by_vertex)
        if self.calibration_factor is not None:
            variance += np.sum((gradient @ self.calibration_factor) ** 2)
        return float(length), float(np.sqrt(max(variance, 0.0)))

    def plane(self, face: int) -> FacePlane:
        """Return the plane of a face, with its outward normal."""
        return face_plane(self.vertices, self.faces[face])


def edges_of_faces(faces: Sequence[Face]) -> Int[np.ndarray, "E 2"]:
    """Return the sides of all faces as edges, each once."""
    pairs = {(min(a, b), max(a, b)) for face in faces for a, b in face.directed_edges}
    return np.array(sorted(pairs), int).reshape(-1, 2)
