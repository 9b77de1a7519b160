"""Choose the noise model of a joint fit from the data: how large which errors are."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration
from ..compilation import compiled, optimised
from ..dataset import Dataset
from ..robots import AbstractField, DHErrors, LinearInPose, RobotError, field_name
from .build import Built, build_problem
from .doubt import Doubt, doubt
from .likelihood import LEAST, LinearisedViews, Sizes, best_step
from .noise import Noise
from .parameters import CORRECTIONS, ROBOT_ERROR, Step
from .priors import Prior
from .problem import JointProblem, NormalEquations
from .scoring import Likeliest, likeliest
from .solver import solve

ROUNDS = 6
"""Of linearising anew with the sizes found, at most."""

SETTLED = 0.01
"""Deviance below which sizes found anew are not better: a tenth of how well they are known."""

FEW = 8
"""Views below which white noise of poses is hard to tell from errors of the camera.

There a model of the robot's error has to be believable besides, or far likelier than white noise.
Real sets left out view by view: six views of koide_charuco 20230920 err by 2.1 px where they erred
by 3.2 as long as the robot was trusted; seven of 20231006, where white noise is not believable, by
1.34 and not 1.8. Five simulated ones with white noise: 1.53 and 2.03.
"""

BELIEVABLE = 3.0
"""Times the sigma of pixels within views that the effective one may be.

A model that is true leaves none of what views disagree in to their pixels. Simulated, it is 1 to 2
times; where the camera's errors pass for the robot's, on real sets, 4 to 10.
"""

DECISIVE = 10.0
"""Deviance, more than white noise gains, for which a field needs not be believable."""

PLAIN = ("trusted", "white")
"""Alternatives without a field."""

FINEST = 1e-4
"""Sigma of pixels, px, below which data count as free of noise."""

TOO_LARGE = 5.0
"""Times the first guess."""

PENALTY = 2.0
"""Deviance that each further size of the field has to gain: Akaike's.

Where there is nothing to find a size gains but half a chi-square's, since half of the time the best
size is zero. But a field that is not there costs more than a small one that is missed: at a price
of one it was taken in one of twenty simulations with white noise alone, at 8 to 25 views, and
their error on unseen views grew by two thirds (`python -m benchmarks regimes`).
"""


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
        return self.doubt.of(np.array([self.parameter_names.index(name) for name in names]))


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
            field besides, linear in position or in the pose, or, where an arm's joints are known,
            of their zeros or of all its Denavit-Hartenberg numbers; False is white noise alone; a
            field of `robots`, or your own, is taken as it is.
        fixed: as `fit_joint` takes them, and so are `free` and `priors`.
        free: see there.
        priors: see there.
        progress: told what is being done.

    Raises:
        ValueError: as `fit_joint` does, and for a prior on what is estimated here.
    """
    say = progress or (lambda _: None)
    for path in priors or ():
        if path.split(".")[0] in (ROBOT_ERROR, CORRECTIONS):
            raise ValueError(
                f"prior on {path!r}: its size is what noise='estimated' finds; give a Noise instead"
            )
    basis = _largest_field(data) if field is None else field or None
    unit = Noise(1.0, 1.0, 1.0, field=(1.0,) * (len(basis.groups) if basis else 0))
    built = build_problem(
        data, start, noise=unit, field=basis, fixed=fixed, free=free, priors=priors
    )
    groups = _groups(built)
    solution, equations = solve(_loose(built.problem))
    placed = data.usable_views()
    views = _Statistics(built, groups, placed, 2.0 * float(equations.cost))
    white, z = views.white_sigma, solution.z

    tried = _candidates(field, basis, views.count)
    guess = _first_guess(np.asarray(z.corrections)[placed], basis, white)
    there = views.linearised(z)
    best = _searched(there, guess, tried)
    robotless = best["trusted"].deviance
    gains = {name: float(robotless - one.deviance) for name, one in best.items()}
    name = list(tried)[-1]
    if field is None:
        name = _choice(best, gains, tried, white, len(placed))
    say(f"errors of the robot: {name}")
    z, there, found, settled = _settled(views, z, there, best[name], tried[name])
    alternatives = tuple(
        Alternative(other, gains[other], _noise(one.sizes, white, tried[other]))
        for other, one in best.items()
    )
    calibration, _ = built.problem.calibration(z)
    carried = jax.tree.map(np.asarray, _doubt(there, found))
    shares = carried.relative_std[np.concatenate([[True] * 3, tried[name][2:]])]
    return NoiseEstimate(
        name,
        _noise(found.sizes, white, tried[name]),
        *_kept(calibration, name),
        alternatives,
        settled,
        tuple(map(float, shares)),
        built.names,
        carried,
    )


def _searched(
    views: LinearisedViews, guess: Sizes, tried: dict[str, Bool[np.ndarray, "robot"]]
) -> dict[str, Likeliest]:
    """The likeliest sizes of each model.

    Each contains the one before, and is searched from where that one ended with what is new far too
    large: a size near zero has next to no slope. Where that ends worse, the one before is kept.
    """
    best: dict[str, Likeliest] = {}
    previous, begin = None, guess
    for name, active in tried.items():
        found = _likeliest(views, begin, jnp.asarray(active))
        if previous is not None and previous.deviance < found.deviance:
            found = previous
        previous = best[name] = found
        if active.any():
            known = np.concatenate([[True], active])
            begin = Sizes.of(jnp.where(known, found.sizes.numbers, TOO_LARGE * guess.numbers))
    return best


class _Statistics:
    """What the free poses and the free camera left, and the chain linearised where one asks."""

    def __init__(
        self,
        built: Built,
        groups: Int[np.ndarray, "free"],
        placed: Int[np.ndarray, "placed"],
        inner: float,
    ):
        problem = built.problem
        camera = sum(k < problem.parameters.camera_size for k in problem.free)
        self.problem, self.groups, self.inner = problem, jnp.asarray(groups), inner
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
        found = _likeliest(there, found.sizes, jnp.asarray(active))
        if float(found.gained) < SETTLED:
            return z, there, found, True
    return z, there, found, False


def _choice(
    best: dict[str, Likeliest],
    gains: dict[str, float],
    tried: dict[str, Bool[np.ndarray, "robot"]],
    white: float,
    views: int,
) -> str:
    """Trusted, white, or the largest field: its groups switch themselves off."""
    field, price = list(tried)[-1], {name: PENALTY * tried[name].sum() for name in tried}

    def believable(name: str) -> bool:
        return views >= FEW or float(best[name].sizes.pixel) <= BELIEVABLE * white

    more = gains[field] - gains["white"]
    likelier = field not in PLAIN and more >= price[field] - price["white"]
    if likelier and (believable(field) or more >= DECISIVE):
        return field
    return "white" if gains["white"] >= price["white"] and believable("white") else "trusted"


def _loose(problem: JointProblem) -> JointProblem:
    """The problem in which every view has a pose of its own: the same program, other priors."""
    weight, free = problem.prior_weight, np.asarray(problem.free)
    held = free[free >= problem.parameters.camera_size]
    return eqx.tree_at(
        lambda p: p.prior_weight,
        problem,
        Step(weight.shared.at[held].set(1.0 / LEAST), jnp.zeros_like(weight.corrections)),
    )


def _candidates(
    field: AbstractField | Literal[False] | None, basis: AbstractField | None, statistics: int
) -> dict[str, Bool[np.ndarray, "robot"]]:
    """What is tried by name: which of translation, rotation, groups of the basis have a size.

    The last has the most of them. A field that is not asked for is tried only where the views
    outnumber its coefficients and the chain's twelve numbers.
    """
    place = np.arange(2 + (0 if basis is None else len(basis.groups)))
    tried = {"trusted": place < 0, "white": place < 2}
    if basis is None or field is not None:
        return tried if basis is None else {**tried, field_name(basis): place >= 0}
    for smaller in basis.nested:
        if statistics >= smaller.size + 12:
            tried[field_name(smaller)] = place < 2 + len(smaller.groups)
    return tried


def _largest_field(data: Dataset) -> AbstractField:
    """That of the arm itself where its joints are known, otherwise linear in the pose."""
    if data.arm is not None:
        return DHErrors(data.arm)
    masked = {view for view, _ in data.masked_views}
    # What stands in for a pose that could not be read is nowhere near the others.
    read = np.array([view not in masked for view in data.view_ids])
    return LinearInPose.over(SE3(data.base_from_tool.wxyz_xyz[read]))


def _first_guess(
    poses: Float[np.ndarray, "placed 6"], basis: AbstractField | None, white: float
) -> Sizes:
    """From how the placed views' own best poses scatter about the start's chain."""
    size = np.median(np.abs(poses).reshape(-1, 2, 3), axis=(0, 2))
    translation, rotation = np.maximum(size, 1e-6)
    groups = [] if basis is None else [name for name, _ in basis.groups]
    field = [translation if name.startswith("translation") else rotation for name in groups]
    numbers = jnp.array([3.0 * white, translation, rotation, *field])
    return Sizes.of(numbers)


@compiled
def _observed(problem: JointProblem, z: Step) -> tuple[NormalEquations, Step]:
    off = problem.off_mean(problem.step(z))
    return problem.observed(z), Step(off.shared[jnp.array(problem.free)], off.corrections)


def _groups(built: Built) -> Int[np.ndarray, "free"]:
    """Number of the field's group that each free shared parameter belongs to; -1 for others."""
    error = built.problem.parameters.start.robot_error
    groups = () if error is None else error.field.groups
    prefixes = [f"{ROBOT_ERROR}.{group}." for group, _ in groups]
    return np.array(
        [
            next((k for k, prefix in enumerate(prefixes) if name.startswith(prefix)), -1)
            for name in built.names
        ]
    )


@compiled
def _weighed(problem: JointProblem, sizes: Sizes, groups: Array) -> JointProblem:
    """The problem with priors of these sizes."""
    chosen, shared = jnp.array(problem.free), problem.prior_weight.shared
    weights = sizes.weights(groups, shared[chosen])
    own = jnp.broadcast_to(weights.corrections, problem.own_free.shape)
    weight = Step(shared.at[chosen].set(weights.shared), own)
    return eqx.tree_at(lambda p: (p.pixel_sigma, p.prior_weight), problem, (sizes.pixel, weight))


_likeliest, _best_step = optimised(likeliest), compiled(best_step)
_doubt = compiled(doubt)


def _noise(sizes: Sizes, white: float, active: Bool[np.ndarray, "robot"]) -> Noise:
    field = tuple(float(size) for size in np.asarray(sizes.field)[active[2:]])
    numbers = (float(sizes.pixel), float(sizes.translation), float(sizes.rotation))
    return Noise(*numbers, field=field, white_pixel=white)


def _kept(calibration: Calibration, name: str) -> tuple[AbstractField | None, Calibration]:
    """The field that was chosen, and the calibration with no other."""
    error = calibration.robot_error
    if name in PLAIN or error is None:
        return None, calibration.uncorrected
    field = next(part for part in error.field.nested if field_name(part) == name)
    error = RobotError(field, error.coefficients[: field.size])
    return field, dataclasses.replace(calibration, robot_error=error)
