"""Estimate the noise model of a joint fit from the data: the standard deviation of every error."""

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
"""Largest number of linearisations, each at the parameters fitted with the last estimated sizes."""

SIZE_TOLERANCE = 0.02
"""Relative change of every size below which the iteration has converged."""

FINEST = 1e-4
"""Smallest pixel sigma, px; data with a smaller one count as free of noise."""

DECIDED = 0.5
"""Probability that the target does not have its stated size, above which its scale is made free."""


class Alternative(NamedTuple):
    """A model of the robot error that was tried.

    Attributes:
        name: "white" where the model has no field, otherwise the field's name; followed by
            ", target_scale" where the target's scale was free as well.
        probability: posterior probability of the model; zero where another field was asked for.
        gain: decrease of the penalised deviance from that of white noise of the poses alone.
        sizes: the standard deviations that maximise its posterior.
    """

    name: str
    probability: float
    gain: float
    sizes: Noise


class ScaleFinding(NamedTuple):
    """The evidence of the views on the size of the target.

    Attributes:
        probability: probability that the size is not as stated.
        size: size of the target over its stated size, if it is not as stated.
        std: standard deviation of `size`.
    """

    probability: float
    size: float
    std: float


class NoiseEstimate(NamedTuple):
    """A noise model, averaged over models of the robot error by their probabilities.

    Attributes:
        name: name of the most probable model.
        noise: standard deviations of all errors in the averaged model.
        field: robot error field; None where the views do not call for one.
        start: the calibration at the end of the estimation.
        alternatives: all models of the robot error that were tried.
        scale: evidence on the target's size; None where its scale was not in question.
        mount_shift: translation (m) and rotation (rad) of the camera's mount with the smooth robot
            error, relative to that with white noise alone; None where there is no smooth error, or
            the mount is held.
        settled: whether the sizes converged.
        relative_std: standard deviations of pixel, translation, rotation and field sizes, relative
            to these sizes; large for a size near zero, which the data do not determine.
        parameter_names: names of the fit's shared parameters.
        doubt: contribution of the sizes' uncertainty to that of the shared parameters.
        prior: prior of the robot's errors.
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
        """The paths of the parameters that are made free because the views call for it."""
        found = self.scale is not None and self.scale.probability > DECIDED
        return (SCALE,) if found else ()

    def doubt_of(self, names: Sequence[str]) -> Doubt:
        """Return the contribution of the sizes' uncertainty for a subset of the parameters."""
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
    """Estimate the standard deviations of all errors by restricted likelihood and priors on arms.

    Args:
        data: data set; below about eight views nothing is reliable, and more are better.
        start: any calibration near enough, with the lens that is to be fitted.
        field: model of the robot error. None averages over a robot with white noise alone, and with
            a field in addition: linear in position or in the pose, or that of an arm of unknown
            geometry, or, where an arm's joints are known, of their zeros or of all its
            Denavit-Hartenberg parameters. False is white noise alone. A field of `robot_errors`, or
            one of your own, is used as it is.
        fixed: paths of parameters to hold, as in `fit_joint`.
        free: paths of parameters to make free, as in `fit_joint`.
        priors: priors on parameters, as in `fit_joint`.
        progress: function that is called with a message on the current step.
        robot_prior: usual sizes of the errors of arms.

    Raises:
        ValueError: as in `fit_joint`, and for a prior on what is estimated here.
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
        """Build the problem with all standard deviations one; their values are set later."""
        unit = Noise(1.0, 1.0, 1.0, field=(1.0,) * (len(basis.groups) if basis else 0))
        more = (SCALE,) if scaled else ()
        return build_problem(
            data, start, noise=unit, field=basis, fixed=fixed, free=(*free, *more), priors=priors
        )

    # First pass: all models on the basis that contains them, linearised at the fit with free poses.
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
        # A field that was asked for is used whatever the probability of white noise.
        last = {list(models)[-1], f"{list(models)[-1]}, {SCALE}"}
        weights = probabilities({name: one for name, one in tried.items() if name in last})
    else:
        weights = probabilities(tried)
    alternatives = _alternatives(tried, weights, views.white_sigma)
    scale = _scale_finding(built, there, solution.z, tried, weights) if asked else None

    # Second pass: only the models with more than negligible probability, on the smallest field that
    # contains them, alternating between the fit and the sizes.
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
    """The statistics of the views from the fit with free poses, for any linearisation.

    Attributes:
        problem: the joint problem.
        groups: group of unknown standard deviation of each free shared parameter, -1 for none.
        inner: sum of squared residuals of the fit with free poses and a free camera, px^2.
        names: names of the groups.
        count: number of statistics: free parameters of the camera and of the views' own poses.
        white_sigma: standard deviation of the noise within views, px.
        known_weight: one over the standard deviation of the priors with known standard deviations.
    """

    def __init__(self, built: Built, placed: Int[np.ndarray, "placed"], inner: float, scale=False):
        problem, groups = built.problem, _groups(built, scale)
        camera = sum(k < problem.parameters.camera_size for k in problem.free)
        self.problem, self.groups, self.inner = problem, jnp.asarray(groups), inner
        error = problem.parameters.start.robot_error
        fitted = () if error is None else tuple(name for name, _ in error.field.groups)
        self.names = (*fitted, SCALE) if scale else fitted
        self.count = camera + int(np.asarray(problem.own_free)[placed].sum())
        seen = int(np.asarray(problem.observations.visible).sum())
        # White sigma: sum of squared residuals over degrees of freedom, 2 n - (camera and free
        # poses).
        white = np.sqrt(inner / max(2 * seen - self.count, 1))
        self.white_sigma = max(float(white), FINEST)
        known = np.asarray(problem.prior_weight.shared)[list(problem.free)]
        self.known_weight = jnp.asarray(np.where(groups < 0, known, 0.0))

    def linearised(self, z: Step) -> LinearisedViews:
        """Linearise the problem at a step."""
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
        """Return the sizes with the groups selected and ordered by name."""
        places = [3 + self.names.index(name) for name in names]
        return Sizes.of(sizes.numbers[jnp.array([0, 1, 2, *places])])


def _settled(
    views: _Statistics,
    ahead: Step,
    models: Mapping[str, Candidate],
    sizes: Sizes,
    prior: SizePrior,
) -> tuple[Step, LinearisedViews, Likeliest, bool]:
    """Alternate between fitting the parameters and averaging the sizes, until the sizes converge.

    Args:
        views: statistics with the field that contains all models.
        ahead: step of all parameters at which the first fit begins.
        models: models to average over.
        sizes: sizes for the first fit.
        prior: prior of the sizes of the field's groups.

    Returns:
        The step of the fit, the views linearised there, the sizes, and whether they converged.
    """
    rounds, settled = 0, False
    z, there = ahead, views.linearised(ahead)
    while True:
        better = solve(_weighed(views.problem, sizes, views.groups), start=ahead)[0].z
        linearised, rounds = views.linearised(better), rounds + 1
        tried = try_all(linearised, models, views.names, sizes, prior, 0.0)
        if not tried:
            # No model has a finite weight, for example where pictures and poses do not belong
            # together: return the last good result.
            return z, there, _at(there, sizes, prior), False
        z, there = better, linearised
        before, sizes = sizes, averaged(tried, kept(probabilities(tried)))
        change = np.abs(np.asarray(sizes.numbers - before.numbers))
        settled = (change <= SIZE_TOLERANCE * np.asarray(before.numbers) + 10.0 * LEAST).all()
        if settled or rounds == ROUNDS:
            return z, there, _at(there, sizes, prior), bool(settled)
        ahead = _ahead(there, z, sizes)


def _ahead(views: LinearisedViews, z: Step, sizes: Sizes) -> Step:
    """Compute the most probable parameters for given sizes, to first order."""
    return jax.tree.map(jnp.add, z, _best_step(views, sizes))


def _carried(z: Step, names: tuple[str, ...], others: tuple[str, ...]) -> Step:
    """Convert a step to the parameters of another problem; parameters that it adds are zero."""
    known = dict(zip(names, np.asarray(z.shared), strict=True))
    shared = np.array([known.get(name, 0.0) for name in others])
    return Step(jnp.asarray(shared), z.corrections)


def _alternatives(
    tried: Mapping[str, Tried], weights: Mapping[str, float], white: float
) -> tuple[Alternative, ...]:
    """Return all models tried, with probabilities and the gain over white noise alone."""
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
    """Estimate the target's size by the most probable model in which its scale is free."""
    scaled = {name: weight for name, weight in weights.items() if tried[name].scaled}
    best = max(scaled, key=lambda name: scaled[name])
    step, std = _shared(views, tried[best].found.sizes)
    place = built.names.index(SCALE)
    size = built.problem.parameters.start.target_scale + z.shared[place] + step[place]
    return ScaleFinding(sum(scaled.values()), float(size), float(std[place]))


def _mount_shift(built: Built, views: LinearisedViews, sizes: Sizes) -> tuple[float, ...] | None:
    """Compute the shift of the mount when the robot error field is removed, to first order."""
    mount = f"{built.problem.parameters.start.transform_names[0]}."
    places = [k for k, name in enumerate(built.names) if name.startswith(mount)]
    if len(places) != 6:
        return None
    # A field with standard deviations of `LEAST` is held at zero.
    nothing = Sizes.of(sizes.numbers.at[3:].set(LEAST))
    with_field, without = (_best_step(views, each).shared for each in (sizes, nothing))
    return tuple(map(float, np.asarray(with_field - without)[places]))


def _concerns_scale(paths: Sequence[str]) -> bool:
    """Return whether the target's scale is among the paths."""
    return SCALE in paths


def _loose(problem: JointProblem) -> JointProblem:
    """Return the problem with a free pose for every view, by changing only the priors.

    Only arrays differ, so that the same compiled program is used.
    """
    # The shared parameters except the camera's get priors so narrow that they are held, and the
    # corrections of the views get none.
    weight, free = problem.prior_weight, np.array(problem.free, dtype=int)
    held = free[free >= problem.parameters.camera_size]
    return eqx.tree_at(
        lambda p: p.prior_weight,
        problem,
        Step(weight.shared.at[held].set(1.0 / LEAST), jnp.zeros_like(weight.corrections)),
    )


@compiled
def _observed(problem: JointProblem, z: Step) -> tuple[NormalEquations, Step]:
    """Return the normal equations of the observations, and the differences from the prior means."""
    off = problem.off_mean(problem.step(z))
    return problem.observed(z), Step(off.shared[problem.chosen], off.corrections)


def _groups(built: Built, scale: bool) -> Int[np.ndarray, "free"]:
    """Return the group of unknown standard deviation of each free shared parameter; -1 for none.

    Args:
        built: problem with the names of its parameters.
        scale: whether the target's scale is a group of its own, the last one.
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
    """Return the problem with priors of the given standard deviations."""
    chosen, shared = problem.chosen, problem.prior_weight.shared
    weights = sizes.weights(groups, shared[chosen])
    own = jnp.broadcast_to(weights.corrections, problem.own_free.shape)
    weight = Step(shared.at[chosen].set(weights.shared), own)
    return eqx.tree_at(lambda p: (p.pixel_sigma, p.prior_weight), problem, (sizes.pixel, weight))


@compiled
def _at(views: LinearisedViews, sizes: Sizes, prior: SizePrior) -> Likeliest:
    """Return the result of a search that ends at the given sizes."""
    at = integrate(views, sizes)
    told = fisher_information(views, at, len(sizes.field))
    told = told + jnp.diag(jnp.pad(prior.spread**-2, (1, 0)))
    return Likeliest(sizes, at.deviance, jnp.zeros(()), told, jnp.array(0))


@compiled
def _shared(
    views: LinearisedViews, sizes: Sizes
) -> tuple[Float[Array, "shared"], Float[Array, "shared"]]:
    """Compute the best step of the shared parameters, and their standard deviations."""
    at = integrate(views, sizes)
    return at.step.shared, jnp.sqrt(jnp.diagonal(at.shared_covariance))


_best_step = compiled(best_step)
_doubt = compiled(doubt)


def _noise(sizes: Sizes, white: float, active: Bool[np.ndarray, "robot"] | None = None) -> Noise:
    """Convert sizes to a `Noise`; with `active`, only the active groups of the field."""
    field = np.asarray(sizes.field)
    field = field if active is None else field[active[2:]]
    numbers = (float(sizes.pixel), float(sizes.translation), float(sizes.rotation))
    return Noise(*numbers, field=tuple(map(float, field)), white_pixel=white)
