"""Widen the covariance of a fit to tracked poses by what its chain of transforms alone tells."""

import dataclasses

import numpy as np
from jaxtyping import Float

from ..engine import TARGET_SCALE, parameter_names
from ..geometry import host_cross_matrices
from .joint_fit import JointFit


def in_named_parameters(
    covariance: Float[np.ndarray, "unknowns unknowns"],
    camera_from_mount: Float[np.ndarray, "4 4"],
    holder_from_world: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "unknowns unknowns"]:
    """Return the covariance of translations and rotations from the one of left twists.

    Args:
        covariance: of left twists of both transforms, and of any other unknowns.
        camera_from_mount, holder_from_world: the transforms.
    """
    by_name = np.eye(len(covariance))
    for k, transform in enumerate((camera_from_mount, holder_from_world)):
        # A left twist (v, w) moves a translation t by v + w x t.
        levers = -host_cross_matrices(transform[None, :3, 3])[0]
        by_name[6 * k : 6 * k + 3, 6 * k + 3 : 6 * k + 6] = levers
    return by_name @ covariance @ by_name.T


def widened_to(fit: JointFit, chain_covariance: Float[np.ndarray, "unknowns unknowns"]) -> JointFit:
    """Return the fit with a covariance that is nowhere smaller than a given one of its chain.

    Args:
        fit: a fit to tracked poses.
        chain_covariance: in the order of the names of both transforms and of the scale's logarithm.
    """
    chain = (*fit.calibration.transform_names, TARGET_SCALE)
    names = [name for name in parameter_names(fit.calibration) if name.split(".")[0] in chain]
    of_chain = dict(zip(names, range(len(chain_covariance)), strict=False))
    rows = [
        k
        for k, name in enumerate(fit.parameter_names)
        if name in of_chain and np.isfinite(fit.std[name])
    ]
    kept = [of_chain[fit.parameter_names[k]] for k in rows]
    covariance = np.array(fit.covariance)
    stated = covariance[np.ix_(rows, rows)]
    lacking = chain_covariance[np.ix_(kept, kept)] - stated
    size = np.sqrt(np.diagonal(stated))
    values, vectors = np.linalg.eigh(lacking / np.outer(size, size))
    vectors = size[:, None] * vectors
    covariance[np.ix_(rows, rows)] += (vectors * np.maximum(values, 0.0)) @ vectors.T
    std = dict(fit.std)
    std |= {fit.parameter_names[k]: float(np.sqrt(covariance[k, k])) for k in rows}
    return dataclasses.replace(fit, covariance=covariance, std=std)
