"""Fit many data sets at once: simulations, bootstraps, a fleet of robots.

Data sets of about the same size are padded to the same shape and share a program
(`batched_fits.py`).
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float, Int

from ..calibration import Calibration
from ..cameras import AbstractLens
from ..dataset import Dataset, repetition_warnings, require_same_set_up, stale_poses
from ..engine import (
    AbstractLoss,
    BuiltProblem,
    Noise,
    ParameterChoice,
    Prior,
    build_problem,
    unprojectable_views_message,
    with_field,
    with_lens,
)
from ..fit_result import Rejection
from ..robot_errors import FieldChoice, checked_field_choice
from ..runtime.array_namespace import stacked_on_device, to_device
from ..runtime.modules import with_fields
from ..runtime.padding import padded_counts
from .batched_fits import (
    FITS_AXIS,
    PerFitInputs,
    batch_size,
    in_batches,
    per_fit_inputs,
    runs_in_turn,
    solve_all,
)
from .gross_errors import without_views
from .undetermined import require_moving_robot, undetermined_motion

SIGMA_ITERATIONS = 6
"""The number of refits with the pixel sigma re-estimated from the residuals.

The last refits change it very little; the number is fixed so that all fits share a compiled loop.
"""


class ManyFits(eqx.Module):
    """The results of many fits: every array has one entry per fit along its first axis.

    A fit that failed has its error in `errors`. Its cost and covariance are NaN, its calibration is
    its start, and `fits[k]` raises the error.

    Attributes:
        calibrations: one `Calibration` whose arrays are stacked; `fits[k]` is the k-th.
        pose_corrections: as in `JointFit`; zero for the views that other data sets have more.
        covariance: covariance of the free common parameters, in the order of `parameter_names`;
            infinite if the data do not determine all of them. Unlike `fit_joint`'s, it does not
            contain errors of held values and priors that the pictures contradict.
        cost: half the sum of squared residuals in pixel sigmas, at the end.
        steps: number of solver steps.
        converged: whether a further step would lower the cost by a negligible amount.
        parameter_names: names of the free parameters that all views have in common.
        warnings: the views that were left out, with their data set, a sentence each.
        errors: the error of each fit; None if there is a result.
    """

    calibrations: Calibration
    pose_corrections: Float[Array, "fits corrected 6"]
    covariance: Float[Array, "fits free free"]
    cost: Float[Array, "fits"]
    steps: Int[Array, "fits"]
    converged: Bool[Array, "fits"]
    parameter_names: tuple[str, ...] = eqx.field(static=True)
    warnings: tuple[str, ...] = eqx.field(static=True, default=())
    errors: tuple[ValueError | None, ...] = eqx.field(static=True, default=())

    def __len__(self) -> int:
        """Return the number of fits."""
        return len(self.cost)

    def __getitem__(self, index: int) -> Calibration:
        """Return one fit's calibration.

        Raises:
            IndexError: there is no such fit.
            ValueError: the fit failed.
        """
        # JAX arrays clamp an index out of range instead of raising; `range` raises.
        checked_index = range(len(self))[index]
        if self.errors and (error := self.errors[checked_index]) is not None:
            raise error
        return jax.tree.map(lambda x: to_device(np.asarray(x)[checked_index]), self.calibrations)


def fit_many(
    data: Sequence[Dataset],
    start: Calibration | Sequence[Calibration],
    *,
    lens: str | AbstractLens | None = None,
    noise: str | Noise = "trusted",
    loss: str | AbstractLoss | None = None,
    fixed: Sequence[str] = (),
    free: Sequence[str] = (),
    priors: Mapping[str, Prior] | None = None,
    field: FieldChoice = "auto",
    devices: Sequence[Any] | None = None,
) -> ManyFits:
    """Fit many data sets, each as `fit_joint` does; the failure of one is that fit's alone.

    Args:
        data: data sets of any numbers of views and points, all with the same mount.
        start: one start for all, or one for each, with the same lens and mount.
        lens, noise, loss, fixed, free, priors, field: as in `fit_joint`, the same for all.
        devices: devices over which the fits are distributed, such as `jax.devices()`; by default
            they run on one.

    Raises:
        ValueError: no data set can be fitted, lenses or mounts differ, or the noise is to be
            estimated, which `calibrate_many` does.

    For example:

        >>> robots = [data, data.select(range(6))]
        >>> len(sv.fit_many(robots, start=truth))  # doctest: +SKIP
        2
    """
    starts = [start] * len(data) if isinstance(start, Calibration) else list(start)
    _require_same_structure(data, starts)
    if noise == "estimated":
        raise ValueError("fit_many takes the noise as given; calibrate_many estimates it")
    field, choice = checked_field_choice(field), ParameterChoice.of(fixed, free, priors)
    starts = [with_field(with_lens(given, lens), field) for given in starts]
    checked, held, warnings, errors = _with_checked_poses(data, starts, choice)
    choice = choice.holding(*held)
    options = {"noise": noise, "loss": loss, "field": field, **choice._asdict()}
    mesh = None if devices is None else Mesh(np.array(devices), (FITS_AXIS,))
    results: dict[int, _Result] = {}
    shared_names: tuple[str, ...] = ()
    for group in _groups_of_one_shape(checked):
        built = _built_by_views(group, starts, options, errors)
        group = {k: item for k, item in group.items() if k not in errors}
        if not group:
            continue
        shared_names = next(iter(built.values())).shared_names
        solved, unprojectable = _solve_group(group, starts, built, mesh)
        for row, k in enumerate(group):
            views = np.flatnonzero(unprojectable[row])
            if len(views):
                names = [data[k].view_ids[view] for view in views]
                errors[k] = unprojectable_views_message(names)
            results[k] = jax.tree.map(lambda x, row=row: x[row], solved)
    named = tuple(
        ValueError(f"data[{k}]: {errors[k]}") if k in errors else None for k in range(len(data))
    )
    if all(named):
        raise next(error for error in named if error is not None)
    arrays = _stacked(results, starts, errors)
    return ManyFits(*arrays, parameter_names=shared_names, warnings=warnings, errors=named)


_Result = tuple[Any, ...]
"""The arrays of one fit, in the order of the fields of `ManyFits`."""


def _groups_of_one_shape(data: Mapping[int, Dataset]) -> list[dict[int, Dataset]]:
    """Return groups of data sets, by their numbers, each padded to one shape."""
    groups: dict[tuple[int, int], dict[int, Dataset]] = {}
    for k, item in data.items():
        groups.setdefault(padded_counts(*item.visible.shape), {})[k] = item
    return [
        group
        # Data sets of one shape need no padding.
        if len({item.visible.shape for item in group.values()}) == 1
        else {k: _padded(item) for k, item in group.items()}
        for group in groups.values()
    ]


def _padded(data: Dataset) -> Dataset:
    """Return a data set with invisible views and points added."""
    observations = jax.tree.map(to_device, data.observations.padded())
    more = tuple(f"padding {k}" for k in range(len(observations.visible) - data.view_count))
    return dataclasses.replace(
        data,
        points=observations.points,
        pixels=observations.pixels,
        visible=observations.visible,
        base_from_tool=observations.base_from_tool,
        joints=observations.joints,
        view_ids=(*data.view_ids, *more),
        pictures=None,
    )


def _usable(data: Dataset) -> tuple[int, ...]:
    """Return the usable views, which decide which pose corrections are free."""
    # Called as a function, because Equinox copies a module for each call of a method.
    return tuple(Dataset.usable_views(data).tolist())


def _built_by_views(
    group: Mapping[int, Dataset],
    starts: Sequence[Calibration],
    options: Mapping[str, Any],
    errors: dict[int, str],
) -> dict[tuple[int, ...], BuiltProblem]:
    """Build the problem of each pattern of usable views; add the errors of those without one.

    Problems with the same usable views differ only in what `per_fit_inputs` returns.
    """
    built: dict[tuple[int, ...], BuiltProblem] = {}
    for k, item in group.items():
        views = _usable(item)
        if views not in built:
            try:
                built[views] = build_problem(item, starts[k], **options)
            except ValueError as error:
                errors[k] = str(error)
    return built


def _solve_group(
    group: Mapping[int, Dataset],
    starts: Sequence[Calibration],
    built_by_views: Mapping[tuple[int, ...], BuiltProblem],
    mesh: Mesh | None,
) -> tuple[_Result, Bool[np.ndarray, "fits views"]]:
    """Solve the problems of one shape; return their stacked results and unprojectable views."""
    numbers, built = list(group), next(iter(built_by_views.values()))
    problem = with_fields(built.problem, parameters=built.problem.parameters.with_aspect_flag)
    sigma_iterations = SIGMA_ITERATIONS if built.depends_on_sigma and not built.sigma_known else 0

    def inputs(row: int) -> PerFitInputs:
        k = numbers[row]
        usable = built_by_views[_usable(group[k])].problem.per_view_free
        return starts[k], group[k].observations, usable

    *results, unprojectable = in_batches(
        inputs,
        len(numbers),
        batch_size(len(numbers), 1 if mesh is None else mesh.size),
        lambda stacked, count: solve_all(
            eqx.tree_at(per_fit_inputs, problem, stacked),
            count,
            built.sigma_known,
            sigma_iterations,
            mesh,
            runs_in_turn(),
        ),
    )
    return tuple(results), unprojectable


def _stacked(
    results: Mapping[int, _Result], starts: Sequence[Calibration], errors: Mapping[int, str]
) -> _Result:
    """Return the results of all fits in their order, with NaN for those that failed."""
    example = next(result for k, result in results.items() if k not in errors)
    views = max(len(corrections) for _, corrections, *_ in results.values())
    rows = []
    for k, start in enumerate(starts):
        if k in errors:
            _, corrections, covariance, cost, steps, converged = example
            nothing = np.full_like(covariance, np.nan), np.full_like(cost, np.nan)
            rest = (*nothing, np.zeros_like(steps), np.zeros_like(converged))
            calibration, corrections = start, np.zeros_like(corrections)
        else:
            calibration, corrections, *rest = results[k]
        more_views = ((0, views - len(corrections)), (0, 0))
        rows.append((calibration, np.pad(corrections, more_views), *rest))
    return stacked_on_device(rows)


def _require_same_structure(data: Sequence[Dataset], starts: Sequence[Calibration]) -> None:
    """Raise a `ValueError` unless data sets and starts agree in mount and structure."""
    if not data:
        raise ValueError("fit_many: expected at least one data set, found none")
    for k, item in enumerate(data):
        if item.hands is not None:
            raise ValueError(f"data[{k}]: two arms are fitted by fit_joint and calibrate_many only")
        if item.depths is not None:
            raise ValueError(
                f"data[{k}]: depths count in fit_joint and calibrate_many only; drop them by "
                "with_depths(None)"
            )
    if len(starts) != len(data):
        raise ValueError(f"start: expected one, or {len(data)}, found {len(starts)}")
    mount = data[0].mount
    for k, item in enumerate(data):
        if item.mount != mount:
            raise ValueError(f"data[{k}]: expected {mount} as data[0], found {item.mount}")
    structure = jax.tree.structure(starts[0])
    for k, item in enumerate(starts):
        if jax.tree.structure(item) != structure:
            raise ValueError(f"start[{k}]: lens, picture size or mount differs from start[0]")


def _with_checked_poses(
    data: Sequence[Dataset],
    starts: Sequence[Calibration],
    choice: ParameterChoice,
) -> tuple[dict[int, Dataset], tuple[str, ...], tuple[str, ...], dict[int, str]]:
    """Return the data without poses that were not read again, and what the checks found.

    Returns:
        The data sets that can be fitted, by number; the parameters to hold, which no motion of the
        robots determines, as in `fit_joint`; warnings that name the views that are left out; and
        the errors, by number: pictures of another size than the start's; a robot that did not move
        or rotate, or whose motion leaves other parameters undetermined than the first one's, since
        all fits have the same parameters.
    """
    checked: dict[int, Dataset] = {}
    held: tuple[str, ...] = ()
    warnings: list[str] = []
    errors: dict[int, str] = {}
    for k, (item, start) in enumerate(zip(data, starts, strict=True)):
        try:
            require_same_set_up("the start", start, item)
            require_moving_robot(item, start, choice)
        except ValueError as error:
            errors[k] = str(error)
            continue
        stale = stale_poses(item)
        used = without_views(item, stale)
        rejections = [Rejection(item.view_ids[view], None, text) for view, text in stale.items()]
        warnings += [f"data[{k}]: {text}" for text in repetition_warnings(rejections)]
        undetermined = undetermined_motion(used, start, choice).held
        if checked and undetermined != held:
            described = [", ".join(names) or "nothing" for names in (held, undetermined)]
            errors[k] = (
                f"its motion leaves {described[1]} undetermined, but data[{next(iter(checked))}]'s "
                f"leaves {described[0]}; fit them separately, or hold these parameters by fixed="
            )
            continue
        held = undetermined
        checked[k] = used
    return checked, held, tuple(warnings), errors
