"""Build the least-squares problem of a joint fit from the user's arguments.

It combines the lens, the noise model, the free and fixed parameters, and the priors.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float

from ..calibration import Calibration
from ..cameras import AbstractLens, Camera, start_lens
from ..dataset import Dataset
from ..robot_errors import AbstractField, RobotError
from .losses import AbstractLoss, loss_by_name
from .noise import Noise
from .parameters import ROBOT_ERROR, Parameters, Step, parameter_names, select
from .priors import Prior
from .problem import JointProblem, valid_at_start


class Built(eqx.Module):
    """A least-squares problem together with the names of its parameters.

    Attributes:
        problem: the problem, in the parameters' own units.
        names: names of the free shared parameters.
        own_names: names of the free parameters of single views, in order.
        noise: the assumed noise; None where the robot's poses are taken as exact.
        lost: points that were seen but cannot be projected at the start; they are left out.
    """

    problem: JointProblem
    names: tuple[str, ...] = eqx.field(static=True)
    own_names: tuple[str, ...] = eqx.field(static=True)
    noise: Noise | None = eqx.field(static=True)
    lost: Bool[np.ndarray, "views points"]

    @property
    def sigma_known(self) -> bool:
        """Whether the pixel sigma is taken as given; if not, it is estimated from the residuals."""
        return self.noise is not None and self.noise.bounds_poses

    @property
    def sigma_matters(self) -> bool:
        """Whether the result depends on the pixel sigma, because of a prior or a robust loss."""
        weight = self.problem.prior_weight
        shared = np.asarray(weight.shared)[list(self.problem.free)]
        own = np.asarray(weight.corrections)[np.asarray(self.problem.own_free)]
        return self.problem.loss is not None or bool(shared.any() or own.any())


def build_problem(
    data: Dataset,
    start: Calibration,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "trusted",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    field: AbstractField | None = None,
) -> Built:
    """Build the least-squares problem that `fit_joint` solves; arguments and errors as there.

    The coefficients of a robot error field begin at their values in the start if the start has the
    same field, otherwise at zero. Without a field the robot error of the start is kept fixed.
    """
    if not (noise == "trusted" or isinstance(noise, Noise)):
        raise ValueError(
            'noise is "trusted", "estimated" or a Noise(pixel, translation, rotation), and what '
            f"estimates it is fit_joint alone; found {noise!r}"
        )
    for argument, paths in (("fixed", fixed), ("free", free)):
        if isinstance(paths, str):
            raise ValueError(f"{argument}: expected paths, as in ({paths!r},); found {paths!r}")
    if start.mount != data.mount:
        raise ValueError(f"the start is {start.mount}, the data {data.mount}")
    start = with_field(with_lens(start, lens), field)
    priors = dict(priors or {})
    views = data.usable_views()
    if len(views) < 3 and not priors:
        raise ValueError(
            f"a joint fit needs at least 3 views with 4 points each, or priors; found {len(views)}"
        )

    known = noise if isinstance(noise, Noise) else None
    parameters = Parameters(start)
    count = parameters.shared_size
    names = parameter_names(start, data.view_ids if known else ())
    held = ["target_scale"]
    if field is None and start.robot_error is not None:
        held.append(ROBOT_ERROR)
    # `free` overrides what is held by default; `fixed` overrides both.
    moves = ~select(names, held) | select(names, free)
    moves &= ~select(names, fixed)
    mean, weight = _priors(names, count, priors, known, field)
    if known is not None:
        # The correction of a view with too few points to determine its pose is held, unless a prior
        # constrains it.
        placed = np.isin(np.arange(data.view_count), views).repeat(6)
        moves[count:] &= placed | (weight[count:] > 0.0)
    problem = JointProblem(
        parameters,
        data.observations,
        jnp.asarray(known.pixel if known else 1.0, dtype=float),
        tuple(int(k) for k in np.flatnonzero(moves[:count])),
        jnp.asarray(moves[count:].reshape(-1, 6)),
        _as_step(mean, count),
        _as_step(weight, count),
        Step(jnp.ones(int(moves[:count].sum())), jnp.ones((len(names[count:]) // 6, 6))),
        loss_by_name(loss),
    )
    lost = np.asarray(data.visible & ~valid_at_start(problem))
    _refuse_blind_views(data, lost)
    visible = data.visible & ~jnp.asarray(lost)
    problem = eqx.tree_at(lambda p: p.observations.visible, problem, visible)
    return Built(
        problem,
        tuple(names[k] for k in problem.free),
        tuple(names[count + k] for k in np.flatnonzero(moves[count:])),
        known,
        lost,
    )


def without_robot(
    data: Dataset, camera: Camera, camera_from_world: SE3
) -> tuple[Dataset, Calibration]:
    """Return data and a start in which each view's own camera pose replaces the robot's report.

    With both transforms held, the corrections of the reported poses are then free camera poses: the
    corrected pose of a view is `exp(correction) @ camera_from_world`.
    """
    still = Calibration(camera, SE3.identity(), SE3.identity(), "eye_in_hand")
    placed = dataclasses.replace(
        data, base_from_tool=camera_from_world.inverse(), mount="eye_in_hand"
    )
    return placed, still


def with_lens(start: Calibration, lens: str | AbstractLens | None) -> Calibration:
    """Return the start with another lens, initialised from its own lens; None keeps its own."""
    # The region describes the data of an earlier fit, so that it does not apply to a start.
    start = dataclasses.replace(start, region=None)
    if lens is None:
        return start
    return eqx.tree_at(lambda c: c.camera.lens, start, start_lens(lens, start.camera.lens))


def with_field(start: Calibration, field: AbstractField | None) -> Calibration:
    """Return the start with a given robot error field; None keeps its own."""
    known = start.robot_error
    if field is None or (known is not None and bool(eqx.tree_equal(known.field, field))):
        return start
    return dataclasses.replace(start, robot_error=RobotError.none(field))


def _priors(
    names: tuple[str, ...],
    shared: int,
    priors: Mapping[str, Prior],
    noise: Noise | None,
    field: AbstractField | None,
) -> tuple[Float[np.ndarray, "parameters"], Float[np.ndarray, "parameters"]]:
    """Return the prior mean and weight of every parameter.

    A mean of NaN is the value of the start. The weight is one over the standard deviation; zero is
    no prior.
    """
    mean, weight = np.full(len(names), np.nan), np.zeros(len(names))
    groups = () if field is None else field.groups
    if noise is not None:
        if len(noise.field) != len(groups):
            raise ValueError(
                f"Noise.field: expected one deviation for each of the field's {len(groups)} "
                f"groups, found {len(noise.field)}" + ("; say field= too" if not groups else "")
            )
        for (group, _), deviation in zip(groups, noise.field, strict=True):
            chosen = select(names, (f"{ROBOT_ERROR}.{group}",))
            mean[chosen], weight[chosen] = 0.0, 1.0 / deviation
        # One over infinity is a weight of zero, which is no prior: the poses are then free.
        deviations = np.repeat([noise.translation, noise.rotation], 3)
        weight[shared:] = np.tile(1.0 / deviations, (len(names) - shared) // 6)
    for path, prior in priors.items():
        chosen = select(names, (path,))
        turning = [names[k] for k in np.flatnonzero(chosen) if ".rotation." in names[k]]
        if prior.mean is not None and turning:
            raise ValueError(f"prior on {path!r}: a rotation's prior is about the start; no mean")
        weight[chosen] = 1.0 / prior.std
        if prior.mean is not None:
            mean[chosen] = prior.mean
    return mean, weight


def _as_step(numbers: Float[np.ndarray, "parameters"], shared: int) -> Step:
    """Split a flat vector into the shared parameters and six per view."""
    return Step(jnp.asarray(numbers[:shared]), jnp.asarray(numbers[shared:].reshape(-1, 6)))


def _refuse_blind_views(data: Dataset, lost: Bool[np.ndarray, "views points"]) -> None:
    """Raise if the start cannot project a single point of some view.

    Raises:
        ValueError: every point seen in a view lies behind the camera or outside the lens's domain.
    """
    seen = np.asarray(data.visible).sum(axis=1)
    blind = [data.view_ids[k] for k in range(len(seen)) if seen[k] > 0 and lost[k].sum() == seen[k]]
    if blind:
        raise ValueError(nowhere(blind))


def nowhere(views: Sequence[str]) -> str:
    """Return the error message for views of which the start cannot project a single point."""
    return (
        f"start: every point of view {', '.join(views)} lies behind the camera or outside the "
        f"lens's domain; start nearer to the truth (fit_staged), or check the poses"
    )
