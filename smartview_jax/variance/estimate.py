"""Choose the noise model of a joint fit from the data: how large which errors are."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration
from ..compilation import compiled
from ..dataset import Dataset
from ..engine import (
    CORRECTIONS,
    ROBOT_ERROR,
    Built,
    JointProblem,
    Noise,
    NormalEquations,
    Prior,
    Step,
    build_problem,
    solve,
)
from ..robot_errors import AbstractField, RobotPrior
from .alternatives import (
    SCALE,
    Candidate,
    Tried,
    averaged,
    candidates,
    field_of,
    first_guess,
    kept,
    largest_field,
    probabilities,
    size_prior,
    try_all,
)
from .doubt import Doubt, doubt
from .likelihood import LEAST, LinearisedViews, Sizes, best_step, integrate
from .scoring import Likeliest, SizePrior, fisher_information

ROUNDS = 6
"""Of linearising anew with the sizes found, at most."""

SIZE_TOLERANCE = 0.02
"""Relative change of every size below which sizes found anew are not better."""

FINEST = 1e-4
"""Sigma of pixels, px, below which data count as free of noise."""

DECIDED = 0.5
"""Probability of another size of the target above which it is made free."""


class Alternative(NamedTuple):
    """A model of the robot's error that was tried.

    Attributes:
        name: "white", where it has no field, or the field's; with ", target_scale" where the
            target's size was free besides.
        probability: of the model after the views were seen; zero where a field was asked for
            instead.
        gain: penalised deviance below white noise of the poses alone.
        sizes: the errors at which its posterior is largest.
    """

    name: str
    probability: float
    gain: float
    sizes: Noise


class ScaleFinding(NamedTuple):
    """What the views say of the target's size.

    Attributes:
        probability: that it is not as stated.
        size: of the target over its stated one, if it is not.
        std: of `size`.
    """

    probability: float
    size: float
    std: float


class NoiseEstimate(NamedTuple):
    """A noise model averaged over the models of the robot's error by their probabilities.

    Attributes:
        name: of the most probable model.
        noise: the sizes of all errors: standard deviations of the averaged model.
        field: of the robot's error; None where the views have no use for one.
        start: the calibration that the estimate ended at.
        alternatives: every model of the robot's error that was tried.
        scale: what the views say of the target's size; None where it was not a question.
        mount_shift: translation (m) and rotation (rad) by which the smooth error of the robot moves
            the camera's mount, beside a robot with white noise alone; None where there is none, or
            the mount is held.
        settled: whether the sizes stopped changing.
        relative_std: of pixels, translations, rotations and groups of the field, as shares of their
            sizes; of one that is next to nothing the data do not tell, and it is large.
        parameter_names: of the fit's shared parameters.
        doubt: what the sizes' own uncertainty means for these.
        prior: of the robot's errors.
    """

    name: str
    noise: Noise
    field: AbstractField | None
    start: Calibration
    alternatives: tuple[Alternative, ...]
    scale: ScaleFinding | None
    mount_shift: tuple[float, ...] | None
    settled: bool
    relative_std: tuple[float, ...]
    parameter_names: tuple[str, ...]
    doubt: Doubt
    prior: RobotPrior

    @property
    def free(self) -> tuple[str, ...]:
        """Paths that the views made free."""
        found = self.scale is not None and self.scale.probability > DECIDED
        return (SCALE,) if found else ()

    def doubt_of(self, names: Sequence[str]) -> Doubt:
        """Return the doubt of some of the parameters."""
        return self.doubt.of(np.array([self.parameter_names.index(n) for n in names], dtype=int))


def estimate_noise(
    data: Dataset,
    start: Calibration,
    field: AbstractField | Literal[False] | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    progress: Callable[[str], None] | None = None,
    robot_prior: RobotPrior | None = None,
) -> NoiseEstimate:
    """Find the sizes of all errors by restricted likelihood and what is known of arms.

    Args:
        data: the more views the better; below about eight nothing is reliable.
        start: any calibration near enough, with the lens that is to be fitted.
        field: None averages over a robot with white noise, and with a field besides: linear in
            position or in the pose, or that of an arm that nobody described, or, where an arm's
            joints are known, of their zeros or of all its Denavit-Hartenberg numbers; False is
            white noise alone; a field of `robot_errors`, or your own, is taken as it is.
        fixed: as `fit_joint` takes them, and so are `free` and `priors`.
        free: see there.
        priors: see there.
        progress: told what is being done.
        robot_prior: how large errors of arms usually are.

    Raises:
        ValueError: as `fit_joint` does, and for a prior on what is estimated here.
    """
    say = progress or (lambda _: None)
    prior = robot_prior or RobotPrior()
    if field is False:
        start = start.uncorrected
    for path in priors or ():
        if path.split(".")[0] in (ROBOT_ERROR, CORRECTIONS):
            raise ValueError(
                f"prior on {path!r}: its size is what noise='estimated' finds; give a Noise instead"
            )

    def built_with(basis: AbstractField | None, scaled: bool) -> Built:
        unit = Noise(1.0, 1.0, 1.0, field=(1.0,) * (len(basis.groups) if basis else 0))
        more = (SCALE,) if scaled else ()
        return build_problem(
            data, start, noise=unit, field=basis, fixed=fixed, free=(*free, *more), priors=priors
        )

    placed = data.usable_views()
    held = ROBOT_ERROR in fixed
    if held:
        basis, field = start.field, False
    else:
        basis = largest_field(data, len(placed)) if field is None else field or None
    asked = prior.wrong_target > 0.0 and not _concerns_scale((*fixed, *free, *(priors or ())))
    built = built_with(basis, asked)
    solution, equations = solve(_loose(built.problem))
    views = _Statistics(built, placed, 2.0 * float(equations.cost), asked)
    sizes_prior = size_prior(prior, basis, asked)
    models = candidates(field, None if held else basis)
    guess = first_guess(sizes_prior, views.white_sigma)
    there = views.linearised(solution.z)
    tried = try_all(there, models, views.names, guess, sizes_prior, prior.wrong_target)
    if not tried:
        raise ValueError(
            "no model explains the views: their own best poses cannot be linearised; "
            "start nearer to the truth (fit_staged), or check the poses"
        )
    if field:
        # Who asks for a model is given it.
        last = {list(models)[-1], f"{list(models)[-1]}, {SCALE}"}
        weights = probabilities({name: one for name, one in tried.items() if name in last})
    else:
        weights = probabilities(tried)
    alternatives = _alternatives(tried, weights, views.white_sigma)
    scale = _scale_finding(built, there, solution.z, tried, weights) if asked else None

    scaled = scale is not None and scale.probability > DECIDED
    weights = kept({name: w for name, w in weights.items() if tried[name].scaled == scaled})
    named = {name.removesuffix(f", {SCALE}"): weight for name, weight in weights.items()}
    say(f"errors of the robot: {', '.join(f'{n} {w:.2f}' for n, w in named.items())}")
    smooth = basis if held else field_of(basis, models, set(named))
    ahead = _ahead(there, solution.z, averaged(tried, weights))
    before, first = built, views
    built = built_with(smooth, scaled)
    views = _Statistics(built, placed, first.inner)
    z, there, found, settled = _settled(
        views,
        _carried(ahead, before.names, built.names),
        {name: models[name] for name in named},
        first.sizes_of(averaged(tried, weights), views.names),
        size_prior(prior, smooth, False),
    )
    calibration, _ = built.problem.calibration(z)
    carried = jax.tree.map(np.asarray, _doubt(there, found))
    return NoiseEstimate(
        max(named, key=lambda name: named[name]),
        _noise(found.sizes, views.white_sigma),
        smooth,
        calibration if smooth is not None else calibration.uncorrected,
        alternatives,
        scale,
        None if smooth is None else _mount_shift(built, there, found.sizes),
        settled,
        tuple(map(float, carried.relative_std)),
        built.names,
        carried,
        prior,
    )


class _Statistics:
    """What the free poses and the free camera left, and the chain linearised where one asks."""

    def __init__(self, built: Built, placed: Int[np.ndarray, "placed"], inner: float, scale=False):
        problem, groups = built.problem, _groups(built, scale)
        camera = sum(k < problem.parameters.camera_size for k in problem.free)
        self.problem, self.groups, self.inner = problem, jnp.asarray(groups), inner
        error = problem.parameters.start.robot_error
        fitted = () if error is None else tuple(name for name, _ in error.field.groups)
        self.names = (*fitted, SCALE) if scale else fitted
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

    def sizes_of(self, sizes: Sizes, names: tuple[str, ...]) -> Sizes:
        """Return the sizes of some of the groups, in another order."""
        places = [3 + self.names.index(name) for name in names]
        return Sizes.of(sizes.numbers[jnp.array([0, 1, 2, *places])])


def _settled(
    views: _Statistics,
    ahead: Step,
    models: Mapping[str, Candidate],
    sizes: Sizes,
    prior: SizePrior,
) -> tuple[Step, LinearisedViews, Likeliest, bool]:
    """Alternate between the parameters for given sizes and the averaged sizes at these parameters.

    Args:
        views: with the field that holds all models.
        ahead: step of all parameters where the first fit begins.
        models: to average over.
        sizes: where the first fit begins.
        prior: of the sizes of the field's groups.
    """
    rounds, settled = 0, False
    z, there = ahead, views.linearised(ahead)
    while True:
        better = solve(_weighed(views.problem, sizes, views.groups), start=ahead)[0].z
        linearised, rounds = views.linearised(better), rounds + 1
        tried = try_all(linearised, models, views.names, sizes, prior, 0.0)
        if not tried:
            # The fit fell apart, as where pictures and poses do not belong together.
            return z, there, _at(there, sizes, prior), False
        z, there = better, linearised
        before, sizes = sizes, averaged(tried, kept(probabilities(tried)))
        change = np.abs(np.asarray(sizes.numbers - before.numbers))
        settled = (change <= SIZE_TOLERANCE * np.asarray(before.numbers) + 10.0 * LEAST).all()
        if settled or rounds == ROUNDS:
            return z, there, _at(there, sizes, prior), bool(settled)
        ahead = _ahead(there, z, sizes)


def _ahead(views: LinearisedViews, z: Step, sizes: Sizes) -> Step:
    """Return the most probable parameters for given sizes, to first order."""
    return jax.tree.map(jnp.add, z, _best_step(views, sizes))


def _carried(z: Step, names: tuple[str, ...], others: tuple[str, ...]) -> Step:
    """Return a step of the parameters that another problem has; zero for those it adds."""
    known = dict(zip(names, np.asarray(z.shared), strict=True))
    shared = np.array([known.get(name, 0.0) for name in others])
    return Step(jnp.asarray(shared), z.corrections)


def _alternatives(
    tried: Mapping[str, Tried], weights: Mapping[str, float], white: float
) -> tuple[Alternative, ...]:
    alone = float(tried["white"].found.deviance)
    return tuple(
        Alternative(
            name,
            weights.get(name, 0.0),
            alone - float(one.found.deviance),
            _noise(one.found.sizes, white, one.active),
        )
        for name, one in tried.items()
    )


def _scale_finding(
    built: Built, views: LinearisedViews, z: Step, tried: Mapping[str, Tried], weights: dict
) -> ScaleFinding:
    """Return the size of the target by the most probable model in which it is free."""
    scaled = {name: weight for name, weight in weights.items() if tried[name].scaled}
    best = max(scaled, key=lambda name: scaled[name])
    step, std = _shared(views, tried[best].found.sizes)
    place = built.names.index(SCALE)
    size = built.problem.parameters.start.target_scale + z.shared[place] + step[place]
    return ScaleFinding(sum(scaled.values()), float(size), float(std[place]))


def _mount_shift(built: Built, views: LinearisedViews, sizes: Sizes) -> tuple[float, ...] | None:
    """Return how far the mount moves where the field is let go of, to first order."""
    mount = f"{built.problem.parameters.start.transform_names[0]}."
    places = [k for k, name in enumerate(built.names) if name.startswith(mount)]
    if len(places) != 6:
        return None
    nothing = Sizes.of(sizes.numbers.at[3:].set(LEAST))
    with_field, without = (_best_step(views, each).shared for each in (sizes, nothing))
    return tuple(map(float, np.asarray(with_field - without)[places]))


def _concerns_scale(paths: Sequence[str]) -> bool:
    return SCALE in paths


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


def _groups(built: Built, scale: bool) -> Int[np.ndarray, "free"]:
    """Number the group of unknown size of each free shared parameter; -1 for those in none.

    Args:
        built: whose parameters they are.
        scale: whether the target's size is a group of its own, the last one.
    """
    error = built.problem.parameters.start.robot_error
    groups = () if error is None else error.field.groups
    prefixes = [f"{ROBOT_ERROR}.{group}." for group, _ in groups]
    prefixes += [SCALE] if scale else []
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


@compiled
def _at(views: LinearisedViews, sizes: Sizes, prior: SizePrior) -> Likeliest:
    """Return what a search that ends at these sizes gives."""
    at = integrate(views, sizes)
    told = fisher_information(views, at, len(sizes.field))
    told = told + jnp.diag(jnp.pad(prior.spread**-2, (1, 0)))
    return Likeliest(sizes, at.deviance, jnp.zeros(()), told, jnp.array(0))


@compiled
def _shared(
    views: LinearisedViews, sizes: Sizes
) -> tuple[Float[Array, "shared"], Float[Array, "shared"]]:
    """Return the best step of the shared parameters, and their standard deviations."""
    at = integrate(views, sizes)
    return at.step.shared, jnp.sqrt(jnp.diagonal(at.shared_covariance))


_best_step = compiled(best_step)
_doubt = compiled(doubt)


def _noise(sizes: Sizes, white: float, active: Bool[np.ndarray, "robot"] | None = None) -> Noise:
    field = np.asarray(sizes.field)
    field = field if active is None else field[active[2:]]
    numbers = (float(sizes.pixel), float(sizes.translation), float(sizes.rotation))
    return Noise(*numbers, field=tuple(map(float, field)), white_pixel=white)
