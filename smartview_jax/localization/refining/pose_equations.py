"""Write the measurements of an object's pose as linear equations, and solve them.

All equations are about the tangent of the pose at the object, translation first: the true pose is
`world_from_object @ SE3.exp(tangent)`. To first order

    measured - predicted = J tangent + B calibration_error + V vertex_error + noise,

where the errors of the calibration and of the model's vertices are common to all equations. Their
covariances are part of the equations' covariance, so that an error of the robot's pose that moves
all edges of a view counts once, not once per edge.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag, cho_factor, cho_solve

from ...engine import inverse_cholesky_factor
from ...modeling import CalibrationUncertainty, ObjectModel, SeenViews, pixel_jacobians
from ..edges import EdgeLines, Wireframe

MIN_OWN_INFORMATION = 1e-14
"""Smallest share of a parameter's information that may be left when earlier ones are unknown."""


NO_TURNS = np.zeros((6, 6))
"""No prior information on a pose."""


class UndeterminedPoseError(ValueError):
    """Too few features, or all on one line: they do not determine a pose."""


class PoseEquations(NamedTuple):
    """Linear equations about one pose or several, px.

    Attributes:
        residuals: measured minus predicted.
        by_pose: derivatives of the prediction by the tangent of each pose, six numbers for each.
        noise: covariance of the measurement noise in the pictures, px^2.
        by_calibration: derivatives by the numbers of a `CalibrationUncertainty`.
        by_vertices: derivatives by the coordinates of the model's vertices, px/m.
        by_light: derivatives by the light in each view, in its standard deviations; None where no
            light displaces an edge, or where `noise` contains what it does.
    """

    residuals: Float[np.ndarray, "n"]
    by_pose: Float[np.ndarray, "n tangents"]
    noise: Float[np.ndarray, "n n"]
    by_calibration: Float[np.ndarray, "n numbers"]
    by_vertices: Float[np.ndarray, "n coordinates"]
    by_light: Float[np.ndarray, "n lights"] | None = None


class CommonErrors(NamedTuple):
    """The covariances of the errors that all equations share.

    Attributes:
        calibration: of the numbers of a `CalibrationUncertainty`.
        vertices: of the coordinates of the model's vertices, m^2.
        turns: prior information on the tangent of each pose, 1/rad^2: on the turn about the axis of
            a round object, which no picture shows; zero for others.
    """

    calibration: Float[np.ndarray, "numbers numbers"]
    vertices: Float[np.ndarray, "coordinates coordinates"]
    turns: Float[np.ndarray, "tangents tangents"] = NO_TURNS

    @classmethod
    def of(cls, uncertainty: CalibrationUncertainty, model: ObjectModel) -> "CommonErrors":
        """Return the errors of a calibration and of a model; an exact one has no numbers.

        The error of the calibration with which the model was made counts as an error of the model:
        it may be the calibration of these views, but that is not known here.
        """
        count = 0 if model.is_exact else 3 * len(model.vertices)
        vertices = np.zeros((count, count))
        covariance, factor = model.covariance, model.calibration_factor
        if covariance is not None:
            blocks = np.asarray(covariance)
            vertices = blocks if blocks.ndim == 2 else np.asarray(block_diag(*blocks))
        if factor is not None:
            vertices = vertices + factor @ factor.T
        return cls(uncertainty.covariance, vertices, turn_information(model))

    def covariances(
        self, equations: PoseEquations
    ) -> tuple[Float[np.ndarray, "n n"], Float[np.ndarray, "n n"]]:
        """Return the covariances of equations due to the calibration and due to the model, px^2."""
        B, V = equations.by_calibration, equations.by_vertices
        return B @ self.calibration @ B.T, V @ self.vertices @ V.T


def turn_information(model: ObjectModel) -> Float[np.ndarray, "6 6"]:
    """Return the information on a pose's tangent that makes up for the axis of a round object.

    All turns about the axis are equal; the model lists `fold` of them, and the nearest one is off
    by up to half a step, equally probably either way.
    """
    information = np.zeros((6, 6))
    symmetry = model.symmetry
    if symmetry is not None and symmetry.axis is not None:
        variance = (2.0 * np.pi / symmetry.axes[0].fold) ** 2 / 12.0
        information[3:, 3:] = np.outer(symmetry.axis, symmetry.axis) / variance
    return information


class PoseStep(NamedTuple):
    """The solution of pose equations.

    Attributes:
        tangent: best estimate of the pose's tangent.
        pictures, calibration, model: parts of its covariance, which is their sum.
        calibration_jacobian: derivatives of the tangent by the numbers of the calibration.
        calibration_error: likeliest errors of these numbers, given their covariance.
        absorbed: number of equations that these errors explain, at most the number of uncertain
            numbers.
    """

    tangent: Float[np.ndarray, "tangents"]
    pictures: Float[np.ndarray, "tangents tangents"]
    calibration: Float[np.ndarray, "tangents tangents"]
    model: Float[np.ndarray, "tangents tangents"]
    calibration_jacobian: Float[np.ndarray, "tangents numbers"]
    calibration_error: Float[np.ndarray, "numbers"]
    absorbed: float

    @property
    def covariance(self) -> Float[np.ndarray, "tangents tangents"]:
        """The covariance of the tangent."""
        return self.pictures + self.calibration + self.model


def solve_pose(
    equations: PoseEquations,
    errors: CommonErrors,
) -> PoseStep:
    """Return the generalised least-squares solution of pose equations.

    Args:
        equations: of all features.
        errors: the errors that all equations share.

    Raises:
        UndeterminedPoseError: the equations leave the pose undetermined.
    """
    by_calibration, by_model = errors.covariances(equations)
    # C = (J^T W J)^-1, W = (R + B S B^T + V P V^T)^-1; each part X of the sum adds G X G^T with G
    # = C J^T W to the covariance of the solution.
    factor = cho_factor(equations.noise + by_calibration + by_model)
    WJ = cho_solve(factor, equations.by_pose)
    information = equations.by_pose.T @ WJ + errors.turns
    right = WJ.T @ equations.residuals
    whitened = whitening(information)
    covariance = whitened.T @ whitened
    tangent = covariance @ right
    G = covariance @ WJ.T
    rest = equations.residuals - equations.by_pose @ tangent
    from_calibration, from_model = (G @ part @ G.T for part in (by_calibration, by_model))
    # The best linear prediction of the common errors is S B^T W (r - J t); the number of
    # equations it absorbs is the trace of S B^T (W - W J C J^T W) B.
    B = equations.by_calibration
    WB, SBT = cho_solve(factor, B), errors.calibration @ B.T
    free = WB - WJ @ (G @ B)
    weighted_rest = cho_solve(factor, rest)
    # The remaining part of the covariance comes from the pictures.
    return PoseStep(
        tangent,
        covariance - from_calibration - from_model,
        from_calibration,
        from_model,
        # A larger number raises the prediction, and so lowers the residuals.
        -G @ B,
        SBT @ weighted_rest,
        float(np.einsum("ij,ji->", SBT, free)),
    )


def whitening(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return a matrix W with `W^T W` the inverse of an information matrix A, and `W A W^T = 1`.

    Raises:
        UndeterminedPoseError: the information is singular.
    """
    diagonal = information.diagonal()
    # Smallest and largest are NaN if any number is, which compares as False.
    if not 0.0 < diagonal.min() <= diagonal.max() < np.inf:
        raise UndeterminedPoseError("the pose is undetermined: too few features")
    # Correlations instead of covariances, so that metres and radians keep their precision.
    scale = np.sqrt(diagonal)
    factor = np.asarray(inverse_cholesky_factor(information / (scale[:, None] * scale)))
    # NaN, where the matrix is not positive definite, compares as False.
    if not factor.diagonal().max() ** -2 >= MIN_OWN_INFORMATION:
        raise UndeterminedPoseError(
            "the pose is undetermined: too few features, or all on one line"
        )
    return factor / scale


def line_equations(
    lines: EdgeLines,
    model: ObjectModel,
    wireframe: Wireframe,
    views: SeenViews,
    world_from_object: Float[np.ndarray, "4 4"],
    uncertainty: CalibrationUncertainty,
) -> PoseEquations:
    """Return the two equations of each measured edge about the tangent at a pose.

    Args:
        lines: measured at the pose.
        model: of the object.
        wireframe: of the model.
        views: camera and poses.
        world_from_object: pose at which the edges were measured.
        uncertainty: of the calibration in these views.
    """
    view, edge = np.nonzero(lines.measured)
    count = len(view)
    by_light = None
    if lines.by_light is not None:
        # The light of each view is an unknown of its own.
        is_in_view = np.arange(len(lines.measured)) == np.repeat(view, 2)[:, None]
        by_light = is_in_view * np.ravel(lines.by_light[view, edge])[:, None]
    by_calibration = np.zeros((2 * count, len(uncertainty.names)))
    # An exact model has no columns for errors of its vertices.
    by_vertices = np.zeros((2 * count, 0 if model.is_exact else 3 * len(model.vertices)))
    if by_calibration.size or by_vertices.size:
        R, t = world_from_object[:3, :3], world_from_object[:3, 3]
        samples, curves = samples_in_views(lines, wireframe)
        # The wireframe's samples are the same in all views, an outline's are not.
        of_view = np.arange(len(samples)) if len(samples) > 1 else np.zeros(len(lines.points), int)
        projected = [pixel_jacobians(views, points @ R.T + t) for points in samples]
        owners, chains = np.asarray(wireframe.sample_edges), np.asarray(wireframe.sample_chains)
        # The samples of an edge differ in number, hence a loop.
        for k, (v, e) in enumerate(zip(view, edge, strict=True)):
            seen = of_view[v]
            is_used = (curves[seen] == e) & (lines.combination[v, 0] != 0.0)
            on_edge = np.flatnonzero(is_used)
            normals, mix = lines.normals[v, on_edge], lines.combination[v][:, on_edge]
            rows = slice(2 * k, 2 * k + 2)
            by_view = np.einsum("si,sil->sl", normals, projected[seen].by_view[v, on_edge])
            by_calibration[rows] = mix @ by_view @ uncertainty.view_jacobian[v]
            if not by_vertices.size:
                continue
            # A sample between two vertices moves with both, in proportion to its nearness to
            # each. The vertices of a smooth surface count as exact where it has an outline.
            for owner in np.unique(owners[is_used & (chains >= 0)]):
                part = np.flatnonzero(is_used & (owners == owner))
                places = places_on_edges(model, samples[seen][part], owners[part])
                gradient = np.einsum(
                    "si,sij->sj", lines.normals[v, part], projected[seen].by_point[v, part] @ R
                )
                mixed = lines.combination[v][:, part]
                for vertex, share in zip(model.edges[owner], (1.0 - places, places), strict=True):
                    columns = slice(3 * vertex, 3 * vertex + 3)
                    by_vertices[rows, columns] += mixed @ (share[:, None] * gradient)
    return PoseEquations(
        np.ravel(lines.offsets[view, edge]),
        np.reshape(lines.by_pose[view, edge], (-1, 6)),
        np.diag(np.ravel(lines.variances[view, edge])),
        by_calibration,
        by_vertices,
        by_light,
    )


def samples_in_views(
    lines: EdgeLines, wireframe: Wireframe
) -> tuple[Float[np.ndarray, "_ S 3"], Int[np.ndarray, "_ S"]]:
    """Return the samples in the object's frame, m, and their curves: of all views or of each."""
    if lines.outline is None:
        return np.asarray(wireframe.samples)[None], np.asarray(wireframe.sample_curves)[None]
    points, curves = lines.outline
    return np.asarray(points), np.asarray(curves)


def places_on_edges(
    model: ObjectModel, samples: Float[np.ndarray, "S 3"], owners: np.ndarray
) -> Float[np.ndarray, "S"]:
    """Return the positions of samples on their edges: 0 at the first vertex, 1 at the second."""
    starts, ends = (model.vertices[model.edges[owners, k]] for k in (0, 1))
    along = ends - starts
    return ((samples - starts) * along).sum(axis=1) / (along**2).sum(axis=1)
