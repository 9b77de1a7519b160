"""Format the results of a calibration as rows of text, for the terminal and the HTML page."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from ..calibrate_data import CalibrationFit
from ..calibration import Calibration
from ..dataset import Dataset
from ..engine import ROBOT_ERROR
from ..evaluation import (
    UNCORRECTED,
    Deviations,
    ErrorBudget,
    HeldOut,
    Repeatability,
    Row,
    Unseen,
    count_rejected,
    deviations,
    has_correction,
    rejected_by,
    without_rejected_views,
)
from ..joint import JointFit
from ..robot_errors import arm_of
from ..variance import MINIMUM_RELIABLE_VIEWS


class Summary(NamedTuple):
    """The errors of one fit, which are one column of the table of results.

    Attributes:
        name: name of the method.
        fitted: registration errors on all views that were not rejected.
        unseen: held-out errors; None where they were not computed.
    """

    name: str
    fitted: Deviations
    unseen: Unseen | None

    @property
    def held_out(self) -> HeldOut | None:
        """The held-out error by view; None where it was not computed."""
        return None if self.unseen is None else self.unseen.held_out


def summaries(
    fit: CalibrationFit, data: Dataset, unseen: dict[str, Unseen] | None = None
) -> list[Summary]:
    """Return the errors of the staged and the joint fit.

    If the joint fit corrects the robot's error, a third row has its errors without the correction.
    Views that the joint fit rejected entirely are left out for all fits alike.
    """
    unseen, data = unseen or {}, without_rejected_views(data, fit)
    parts = {"staged": fit.staged.calibration, "joint": fit.joint.calibration}
    if has_correction(fit.joint):
        parts[f"joint, {UNCORRECTED}"] = fit.joint.calibration.uncorrected
    return [Summary(name, deviations(part, data), unseen.get(name)) for name, part in parts.items()]


MEASURES = (
    "registration error, mean +- std",
    "registration error, RMS",
    "held-out error, RMS",
    "  its 95 % interval over views",
    "  at the target",
    "  over what the fit expected (1 is honest)",
    "  with a free pose a view",
    "held-out by region, RMS",
)
"""Names of the rows of the table of results."""


def cells(summary: Summary) -> list[str]:
    """Return one column of the table of results: a text for each of `MEASURES`."""
    figures = [
        f"{summary.fitted.mean:.2f} +- {summary.fitted.std:.2f} px",
        f"{summary.fitted.rms:.2f} px",
    ]
    unseen = summary.unseen
    if unseen is None:
        return figures + ["-"] * (len(MEASURES) - len(figures))
    low, high = unseen.held_out.interval()
    return [
        *figures,
        f"{unseen.held_out.deviations.rms:.2f} px",
        f"{low:.2f} to {high:.2f} px",
        f"{unseen.held_out.deviations.rms_mm:.2f} mm",
        "-" if unseen.foretold is None else f"{unseen.foretold.ratio:.2f}",
        "-" if unseen.floor is None else f"{unseen.floor.deviations.rms:.2f} px",
        "-" if unseen.by_region is None else f"{unseen.by_region.deviations.rms:.2f} px",
    ]


def table_rows(rows: Sequence[Summary]) -> list[tuple[str, ...]]:
    """Return the rows of the table that have a number, each beginning with its measure."""
    columns = [cells(row) for row in rows]
    return [row for row in zip(MEASURES, *columns, strict=True) if set(row[1:]) != {"-"}]


COMPARED = (
    "method",
    "mean +- std, px",
    "RMS, px",
    "held out, px",
    "95 % interval, px",
    "held out, mm",
    "left out points, views",
)
"""Headings of the columns of the comparison of methods."""


def compared(row: Row) -> list[str]:
    """Return one row of the comparison of methods: a text for each of `COMPARED`."""
    if row.fitted is None or row.held_out is None:
        return [row.name, "failed", *["-"] * (len(COMPARED) - 2)]
    unseen = row.held_out.deviations
    counts = None if row.rejected is None else count_rejected(row.rejected)
    return [
        row.name,
        f"{row.fitted.mean:.3g} +- {row.fitted.std:.3g}",
        f"{row.fitted.rms:.3g}",
        f"{unseen.rms:.3g}",
        "{:.3g} to {:.3g}".format(*row.held_out.interval()),
        f"{unseen.rms_mm:.3g}",
        "-" if counts is None else f"{counts.points}, {counts.views}",
    ]


def remarks(
    name: str, fitted: Deviations | None, unseen: Unseen | None, failure: str | None = None
) -> list[str]:
    """Return remarks on the numbers of a table: failed fits, and points that are left out."""
    found = [] if failure is None else [f"{name}: {failure}"]
    if fitted is not None and fitted.unpredicted:
        found.append(f"{name}: {fitted.unpredicted} points seen cannot be predicted at all")
    if unseen is None:
        return found
    found += _left_out(name, unseen.held_out)
    if unseen.by_region is not None:
        found += _left_out(f"{name}, by region", unseen.by_region)
    # A fold whose refit failed is reported above already.
    known = {number for number, _ in unseen.held_out.failures}
    others = (unseen.floor, None if unseen.foretold is None else unseen.foretold.predicted)
    for what, part in zip(("with a free pose", "what the fit expected"), others, strict=True):
        for number, why in () if part is None else part.failures:
            if number not in known:
                found.append(f"{name}, {what}: fold {number + 1} failed: {why}")
    return found


def _left_out(name: str, unseen: HeldOut) -> list[str]:
    """Return remarks on held-out points without prediction, extrapolation, and failed folds."""
    found = []
    if unseen.deviations.unpredicted:
        count = unseen.deviations.unpredicted
        found.append(f"{name}: {count} held-out points seen cannot be predicted at all")
    if unseen.extrapolated:
        count, total = len(unseen.extrapolated), sum(map(len, unseen.folds))
        found.append(
            f"{name}: {count} of {total} held-out views lie outside the hull of the viewpoints "
            "that were left: extrapolated"
        )
    found += [f"{name}: fold {k + 1} failed: {why}" for k, why in unseen.failures]
    found += [f"{name}: fold {k + 1} did not converge: {why}" for k, why in unseen.unconverged]
    return found


def rejections(fit: CalibrationFit, data: Dataset) -> list[tuple[str, str]]:
    """Return views and reasons of rejection: whole views first, then counts of rejected points."""
    whole, points = {}, {}
    # A rejection without a point is that of a whole view. A set counts every point once.
    for view, point, reason in rejected_by(fit) or ():
        if point is None:
            whole[view] = reason
        else:
            points.setdefault((view, reason), set()).add(point)
    lines = [(view, f"not used: {reason}") for view, reason in whole.items()]
    order = {view: k for k, view in enumerate(data.view_ids)}
    for (view, reason), which in sorted(points.items(), key=lambda item: order[item[0][0]]):
        lines.append((view, f"{len(which)} points {reason}"))
    return lines


def errors_found(joint: JointFit, data: Dataset) -> list[tuple[str, str]]:
    """Return the estimated variance components and robot error model as rows; empty if none."""
    noise, estimate = joint.noise, joint.estimate
    if noise is None or estimate is None:
        return []
    chances = ", ".join(
        f"{other.name} {other.probability:.2f}"
        for other in estimate.alternatives
        if other.probability >= 0.005
    )
    white = "" if noise.white_pixel is None else f" (within a view {noise.white_pixel:.3f})"
    # A relative standard deviation of 100 % or more belongs to a size that is close to zero, and
    # carries no information.
    known = [f" +- {share:.0%}" if share < 1.0 else "" for share in estimate.relative_std]
    lines = [
        (
            "errors of the robot",
            f"{_in_words(estimate.name)}; probabilities: {chances}",
        ),
        (
            "sizes of errors",
            f"pixels {noise.pixel:.3f} px{known[0]}{white}; poses, each by itself, "
            f"{1e3 * noise.translation:.3f} mm{known[1]} and "
            f"{np.rad2deg(noise.rotation):.4f} deg{known[2]}",
        ),
    ]
    if joint.calibration.robot_error is not None:
        left = deviations(joint.calibration.uncorrected, data).rms
        lines.append(
            (
                "without the correction",
                f"{left:.2f} px RMS: what a program sees that takes the "
                "transforms from here and leaves the robot's error out",
            )
        )
    if not estimate.settled:
        lines.append(("sizes of errors", "still changing when the search ended: take with care"))
    return lines


MODELS = {
    "white": "each pose by itself",
    "position": "smooth, linear in the tool's position",
    "pose": "smooth, linear in the tool's pose",
    "implied_arm": "those of a six-axis arm, which the poses imply",
    "joint_offsets": "zeros of the joints",
    "dh": "zeros of the joints, lengths and twists of the links",
}
"""Descriptions of the robot error models, by name."""


def _in_words(name: str) -> str:
    """Return the name of a robot error model with its description."""
    return f"{name} ({MODELS[name]})" if name in MODELS else name


def models_chosen(names: Iterable[str]) -> str:
    """Return a clause that counts the robot error models of refits; empty if none was estimated."""
    counts = Counter(names).most_common()
    listed = ", ".join(f"{name} {count}" for name, count in counts)
    return f"; errors of the robot there: {listed}" if counts else ""


def halves_agree(halves: Repeatability | None) -> list[tuple[str, str]]:
    """Return a row with the hand-eye difference of two halves of the views; empty if unknown."""
    if halves is None:
        return []
    estimates = [getattr(fit, "estimate", None) for fit in halves.fits]
    chosen = models_chosen(found.name for found in estimates if found is not None)
    text = f"the hand-eye transforms that they find are {halves.words}{chosen}"
    return [("even and odd views", text)]


def budget_rows(budget: ErrorBudget) -> list[tuple[str, str, str]]:
    """Return each cause of error, its RMS in the uncorrected chain and an advice, largest first."""
    return [(part.name, f"{part.px:.3g} px", part.advice) for part in budget.parts]


def explanation_rows(budget: ErrorBudget) -> list[tuple[str, str, str, str, str]]:
    """Return rows on explanations of the robot's error by a single parameter.

    A row has the name, the size, the reduction of the deviance (and that by a robot error field
    instead), the further reduction in addition to that field, and the held-out RMS by region.
    """
    return [
        (
            one.name,
            f"{one.size:.4f} +- {one.std:.4f}",
            f"{one.gain:.0f}; a field {one.field_gain:.0f}",
            f"{one.beside_field:.1f}",
            "" if one.region_px is None else f"{one.region_px:.3g} px",
        )
        for one in budget.explanations
    ]


def parameter_rows(fit: CalibrationFit) -> list[tuple[str, str, str]]:
    """Return the name, value with unit, and standard deviation of the joint fit's parameters.

    The coefficients of a robot error field are included only if they are parameters of a known arm,
    because those of other fields have no meaning one by one.
    """
    calibration = fit.joint.calibration
    slides, rows = _offsets_that_slide(calibration), []
    for name, value in (_values(calibration) | _errors_of_arm(calibration)).items():
        std = fit.joint.std.get(name)
        scale, unit = _unit(name, slides)
        if std is None:
            spread = "held"
        else:
            spread = f"{scale * std:.2g}" if np.isfinite(std) else "not determined"
        rows.append((name, f"{scale * value:.6g} {unit}".strip(), spread))
    return rows


def _values(calibration: Calibration) -> dict[str, float]:
    """Return the camera's, the transforms' (m, rad) and the target's parameters by name."""
    # The names are the keys of `JointFit.std`, so that both can be combined.
    camera = calibration.camera
    values = {
        f"camera.{key}": float(getattr(camera, key)) for key in ("alpha_u", "alpha_v", "u0", "v0")
    }
    values |= {
        f"camera.lens.{key}": float(value)
        for key, value in vars(camera.lens).items()
        if np.ndim(value) == 0
    }
    transforms = (calibration.camera_from_mount, calibration.holder_from_world)
    for name, transform in zip(calibration.transform_names, transforms, strict=True):
        turn = np.asarray(transform.rotation().log())
        shift = np.asarray(transform.translation())
        for part, numbers in (("translation", shift), ("rotation", turn)):
            values |= {
                f"{name}.{part}.{axis}": float(x) for axis, x in zip("xyz", numbers, strict=True)
            }
    values["target_scale"] = float(calibration.target_scale)
    return values


def _errors_of_arm(calibration: Calibration) -> dict[str, float]:
    """Return the robot error coefficients by name, for an arm with known joints; else none."""
    error = calibration.robot_error
    if error is None or arm_of(calibration.field) is None:
        return {}
    numbers = np.asarray(error.coefficients)
    return {
        f"{ROBOT_ERROR}.{name}": float(number)
        for name, number in zip(error.field.names, numbers, strict=True)
    }


def _offsets_that_slide(calibration: Calibration) -> set[str]:
    """Return the names of the joint offsets of prismatic joints, whose unit is a length."""
    arm = arm_of(calibration.field)
    if arm is None:
        return set()
    return {f"{ROBOT_ERROR}.joint_offset.{1 + k}" for k, s in enumerate(arm.prismatic) if s}


def _unit(name: str, slides: set[str]) -> tuple[float, str]:
    """Return the factor from SI units, and the unit to print, of a parameter by its name."""
    if ".translation." in name or ".link_length." in name or name in slides:
        return 1e3, "mm"
    if ".rotation." in name or ".joint_offset." in name or ".link_twist." in name:
        return float(np.rad2deg(1.0)), "deg"
    if name.split(".")[-1] in ("alpha_u", "alpha_v", "u0", "v0"):
        return 1.0, "px"
    return 1.0, ""


def verdict(rows: list[Summary], fit: CalibrationFit) -> str:
    """Return a summary of the result in a few sentences."""
    if not fit.joint.result.converged:
        return f"The joint fit did not converge: {fit.joint.result.message}."
    staged, joint = rows[:2]
    measured, what = [staged.fitted.rms, joint.fitted.rms], "on the views it was fitted to"
    if staged.held_out is not None and joint.held_out is not None:
        unseen = [staged.held_out.deviations.rms, joint.held_out.deviations.rms]
        # Without a single successful fold the held-out RMS is not finite, and the registration
        # errors are reported instead.
        if np.isfinite(unseen).all():
            measured, what = unseen, "on views it never saw"
    # With a free pose for every view the residual is that of the camera model and the detections
    # alone: no calibration of the whole chain can be expected to be below it.
    floor = float(fit.staged.step2.rms)
    text = (
        f"The joint fit predicts target points to {measured[1]:.2f} px RMS {what}; "
        f"the staged pipeline to {measured[0]:.2f} px. "
        f"With a free pose for every view the camera alone would reach {floor:.2f} px"
    )
    if measured[1] > 3.0 * floor:
        text += ": the rest comes from the robot's poses, the target's size or too few views."
    else:
        text += "."
    views = len(joint.fitted.per_view)
    used = int(np.isfinite(joint.fitted.per_view).sum())
    left = count_rejected(rejected_by(fit) or ()).views
    if left:
        text += f" Of {views} views {left} {'is' if left == 1 else 'are'} rejected and not counted."
    if used < MINIMUM_RELIABLE_VIEWS:
        fewest = MINIMUM_RELIABLE_VIEWS
        text += f" With {used} views no figure here is reliable: take {fewest} at least."
    return text
