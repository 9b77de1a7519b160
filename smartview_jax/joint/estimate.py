"""Choose the noise model of a joint fit from the data: how large which errors are."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ..calibration import Calibration
from ..compilation import compiled
from ..dataset import Dataset
from ..robots import AbstractField, RobotError
from .alternatives import believed, gain, largest_field, search
from .build import Built, build_problem
from .doubt import Doubt, doubt
from .likelihood import LEAST, LinearisedViews, Sizes, best_step
from .noise import Noise
from .parameters import CORRECTIONS, ROBOT_ERROR, Step
from .priors import Prior
from .problem import JointProblem, NormalEquations
from .scoring import Likeliest
from .solver import solve

ROUNDS = 6
"""Of linearising anew with the sizes found, at most."""

SETTLED = 0.01
"""Deviance below which sizes found anew are not better: a tenth of how well they are known."""

FINEST = 1e-4
"""Sigma of pixels, px, below which data count as free of noise."""


class Alternative(NamedTuple):
    """A model of the robot's error that was tried.

    Attributes:
        name: "trusted", where the robot has no error; "white", where it has no field; or the
            field's.
        gain: deviance below the trusted robot's (twice the logarithm of the likelihoods' ratio).
        sizes: the errors that would make the data likeliest.
    """

    name: str
    gain: float
    sizes: Noise


class NoiseEstimate(NamedTuple):
    """A noise model chosen by likelihood.

    Attributes:
        name: of the alternative that was chosen.
        noise: the sizes of all errors.
        field: of the robot's error; None where the likelihood has no use for one.
        start: the calibration that the estimate ended at.
        alternatives: every model of the robot's error that was tried.
        settled: whether the sizes stopped changing.
        relative_std: of pixels, translations, rotations and groups of the field, as shares of their
            sizes; of one that is next to nothing the data do not tell, and it is large.
        parameter_names: of the fit's shared parameters.
        doubt: what the sizes' own uncertainty means for these.
    """

    name: str
    noise: Noise
    field: AbstractField | None
    start: Calibration
    alternatives: tuple[Alternative, ...]
    settled: bool
    relative_std: tuple[float, ...]
    parameter_names: tuple[str, ...]
    doubt: Doubt

    def doubt_of(self, names: Sequence[str]) -> Doubt:
        """That of some of the parameters."""
        return self.doubt.of(np.array([self.parameter_names.index(n) for n in names], dtype=int))


def estimate_noise(
    data: Dataset,
    start: Calibration,
    field: AbstractField | Literal[False] | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
) -> NoiseEstimate:
    """Choose a field, and find the sizes of all errors, by restricted likelihood.

    Args:
        data: the more views the better; below about eight nothing is reliable.
        start: any calibration near enough, with the lens that is to be fitted.
        field: None chooses between a robot without error, one with white noise, and one with a
            field besides: linear in position or in the pose, or that of an arm that nobody
            described, or, where an arm's joints are known, of their zeros or of all its
            Denavit-Hartenberg numbers; False is white noise alone; a field of `robots`, or your
            own, is taken as it is.
        fixed: as `fit_joint` takes them, and so are `free` and `priors`.
        free: see there.
        priors: see there.
        progress: told what is being done.

    Raises:
        ValueError: as `fit_joint` does, and for a prior on what is estimated here.
    """
    say = progress or (lambda _: None)
    if field is False:
        start = start.uncorrected
    for path in priors or ():
        if path.split(".")[0] in (ROBOT_ERROR, CORRECTIONS):
            raise ValueError(
                f"prior on {path!r}: its size is what noise='estimated' finds; give a Noise instead"
            )

    def built_with(basis: AbstractField | None) -> Built:
        unit = Noise(1.0, 1.0, 1.0, field=(1.0,) * (len(basis.groups) if basis else 0))
        return build_problem(
            data, start, noise=unit, field=basis, fixed=fixed, free=free, priors=priors
        )

    basis = largest_field(data) if field is None else field or None
    built, placed = built_with(basis), data.usable_views()
    solution, equations = solve(_loose(built.problem))
    views = _Statistics(built, placed, 2.0 * float(equations.cost))
    white, z = views.white_sigma, solution.z

    there = views.linearised(z)
    name, tried = believed(there, data, field, basis, np.asarray(z.corrections)[placed])
    chosen = tried[name]
    say(f"errors of the robot: {name}")
    if chosen.basis is not basis:
        built = built_with(chosen.basis)
        views = _Statistics(built, placed, views.inner)
        more = len(built.names) - views.known
        z = Step(jnp.pad(z.shared[: views.known], (0, more)), z.corrections)
        there = views.linearised(z)
    z, there, found, settled = _settled(views, z, there, chosen.found, chosen.active)
    alternatives = tuple(
        Alternative(other, gain(tried, other), _noise(one.found.sizes, white, one.active))
        for other, one in tried.items()
    )
    calibration, _ = built.problem.calibration(z)
    carried = jax.tree.map(np.asarray, _doubt(there, found))
    shares = carried.relative_std[np.concatenate([[True] * 3, chosen.active[2:]])]
    return NoiseEstimate(
        name,
        _noise(found.sizes, white, chosen.active),
        *_kept(calibration, chosen.field),
        alternatives,
        settled,
        tuple(map(float, shares)),
        built.names,
        carried,
    )


class _Statistics:
    """What the free poses and the free camera left, and the chain linearised where one asks."""

    def __init__(self, built: Built, placed: Int[np.ndarray, "placed"], inner: float):
        problem, groups = built.problem, _groups(built)
        camera = sum(k < problem.parameters.camera_size for k in problem.free)
        self.problem, self.groups, self.inner = problem, jnp.asarray(groups), inner
        self.known = int((groups < 0).sum())
        self.count = camera + int(np.asarray(problem.own_free)[placed].sum())
        seen = int(np.asarray(problem.observations.visible).sum())
        white = np.sqrt(inner / max(2 * seen - self.count, 1))
        self.white_sigma = max(float(white), FINEST)
        known = np.asarray(problem.prior_weight.shared)[list(problem.free)]
        self.known_weight = jnp.asarray(np.where(groups < 0, known, 0.0))

    def linearised(self, z: Step) -> LinearisedViews:
        observed, off = _observed(self.problem, z)
        return LinearisedViews(
            matrix=observed.matrix,
            gradient=observed.gradient,
            between=2.0 * observed.cost - self.inner,
            off_mean=off,
            known_weight=self.known_weight,
            group=self.groups,
            own_free=self.problem.own_free,
            count=jnp.asarray(float(self.count)),
            white_sigma=jnp.asarray(self.white_sigma),
        )


def _settled(
    views: _Statistics,
    z: Step,
    there: LinearisedViews,
    found: Likeliest,
    active: Bool[np.ndarray, "robot"],
) -> tuple[Step, LinearisedViews, Likeliest, bool]:
    """Parameters and sizes that agree: those fitted with these, these likeliest there."""
    for _ in range(ROUNDS):
        ahead = jax.tree.map(jnp.add, z, _best_step(there, found.sizes))
        weighed = _weighed(views.problem, found.sizes, views.groups)
        z = solve(weighed, start=ahead)[0].z
        there = views.linearised(z)
        found = search(there, found.sizes, jnp.asarray(active))
        if float(found.gained) < SETTLED:
            return z, there, found, True
    return z, there, found, False


def _loose(problem: JointProblem) -> JointProblem:
    """The problem in which every view has a pose of its own: the same program, other priors."""
    weight, free = problem.prior_weight, np.array(problem.free, dtype=int)
    held = free[free >= problem.parameters.camera_size]
    return eqx.tree_at(
        lambda p: p.prior_weight,
        problem,
        Step(weight.shared.at[held].set(1.0 / LEAST), jnp.zeros_like(weight.corrections)),
    )


@compiled
def _observed(problem: JointProblem, z: Step) -> tuple[NormalEquations, Step]:
    off = problem.off_mean(problem.step(z))
    return problem.observed(z), Step(off.shared[problem.chosen], off.corrections)


def _groups(built: Built) -> Int[np.ndarray, "free"]:
    """Number of the field's group that each free shared parameter belongs to; -1 for others."""
    error = built.problem.parameters.start.robot_error
    groups = () if error is None else error.field.groups
    prefixes = [f"{ROBOT_ERROR}.{group}." for group, _ in groups]
    return np.array(
        [
            next((k for k, prefix in enumerate(prefixes) if name.startswith(prefix)), -1)
            for name in built.names
        ],
        dtype=int,
    )


@compiled
def _weighed(problem: JointProblem, sizes: Sizes, groups: Array) -> JointProblem:
    """The problem with priors of these sizes."""
    chosen, shared = problem.chosen, problem.prior_weight.shared
    weights = sizes.weights(groups, shared[chosen])
    own = jnp.broadcast_to(weights.corrections, problem.own_free.shape)
    weight = Step(shared.at[chosen].set(weights.shared), own)
    return eqx.tree_at(lambda p: (p.pixel_sigma, p.prior_weight), problem, (sizes.pixel, weight))


_best_step = compiled(best_step)
_doubt = compiled(doubt)


def _noise(sizes: Sizes, white: float, active: Bool[np.ndarray, "robot"]) -> Noise:
    field = tuple(float(size) for size in np.asarray(sizes.field)[active[2:]])
    numbers = (float(sizes.pixel), float(sizes.translation), float(sizes.rotation))
    return Noise(*numbers, field=field, white_pixel=white)


def _kept(
    calibration: Calibration, field: AbstractField | None
) -> tuple[AbstractField | None, Calibration]:
    """The field that was chosen, and the calibration with no other."""
    error = calibration.robot_error
    if field is None or error is None:
        return None, calibration.uncorrected
    error = RobotError(field, error.coefficients[: field.size])
    return field, dataclasses.replace(calibration, robot_error=error)
