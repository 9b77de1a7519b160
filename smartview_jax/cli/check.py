"""Define `smartview check`, which looks at a data set before anything is calibrated with it."""

import dataclasses
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
import typer

import smartview_jax as sv

from . import options
from .documents import print_document, views_left_out
from .fit_options import CameraOption
from .load import load_named
from .terminal import errors_reported, print_lines, progress_line

MIN_VIEWS = 10
"""Fewest usable views for which no more are requested."""

MIN_TURN = 30.0
"""Smallest rotation, degrees, that some pair of views should have."""

MIN_FILLED = 0.25
"""Smallest share of the picture that all points together should cover."""


MAX_SIZE_RATIO = 1.05
"""Largest plausible ratio of the camera's motion to the robot's.

An arm's lengths are right to half a percent; the rest allows for a camera calibrated on few views.
"""


CheckedViewsOption = Annotated[
    options.BadViews | None,
    typer.Option(
        help="What to do with a view that has invalid values: stop (raise) or leave it out (mask).",
        show_default="mask, and say so where calibrate would stop",
    ),
]


class DatasetFigures(NamedTuple):
    """The figures of a data set that need no fit.

    Attributes:
        points: least, greatest and median number of points seen in a view.
        picture_used: fraction of the picture's cells that contain a point; None without points.
        usable_views: number of views with enough points.
        extent: how far the tool moved along x, y, z of the base, m; None below two usable views.
        largest_rotation: largest angle between two tool poses, rad; None below two usable views.
        one_axis: whether all rotations of the tool share an axis.
    """

    points: tuple[int, int, float]
    picture_used: float | None
    usable_views: int
    extent: tuple[float, ...] | None
    largest_rotation: float | None
    one_axis: bool = False


def check(
    dataset: options.DatasetArgument = None,
    camera: CameraOption = None,
    bad_views: CheckedViewsOption = None,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Check a data set: pictures, detections, poses, and whether camera and robot agree.

    Exits with 1 if the data cannot be calibrated as they are.
    """
    with errors_reported(debug):
        treatment = bad_views or options.BadViews.MASK
        if dataset is not None and sv.io.is_rig_folder(dataset):
            with progress_line() as progress:
                rig = sv.load_rig(dataset, treatment, progress)
            known = {} if camera is None else sv.io.read_cameras(camera, tuple(rig.cameras))
            is_masked = any(data.masked_views for data in rig.cameras.values())
            stops = ()
            if bad_views is None and is_masked:
                stops = _stops(lambda: sv.load_rig(dataset, options.BadViews.RAISE))
            findings = _checked_rig(rig, dataset.resolve().name, known, stops)
        else:
            known_camera = None if camera is None else sv.io.read_camera(camera)
            with progress_line() as progress:
                data, name = load_named(dataset, treatment, progress)
            stops = ()
            if bad_views is None and data.masked_views:
                stops = _stops(lambda: load_named(dataset, options.BadViews.RAISE, lambda _: None))
            findings = _checked(data, name, known_camera, stops=stops)
        if json:
            print_document("check", findings.document)
        else:
            findings.print()
        if not findings.are_ready:
            raise typer.Exit(1)
        if not json:
            except_for = ", apart from these doubts" if findings.are_doubtful else ""
            cameras = "cameras" if findings.cameras else "camera"
            print_lines(f"{cameras} and robot agree{except_for}: ready for smartview calibrate")


def _stops(load: Callable[[], object]) -> tuple[str, ...]:
    """Return in a sentence why `smartview calibrate` does not load data; nothing if it does."""
    try:
        load()
    except (ValueError, OSError) as error:
        return (
            f"smartview calibrate stops at this: {error}. Correct it, or leave such views out: "
            "--bad-views mask",
        )
    return ()


class Findings(NamedTuple):
    """The findings in a data set.

    Attributes:
        lines: the figures in words.
        problems: reasons why the data cannot be calibrated.
        doubts: views and figures that do not fit, although most do.
        document: all of it as values for programs.
        cameras: findings in the data of each of several cameras.
    """

    lines: Sequence[str]
    problems: Sequence[str]
    doubts: Sequence[str]
    document: dict[str, Any]
    staged: "sv.StagedFit | None" = None
    cameras: "Sequence[Findings]" = ()

    @property
    def are_ready(self) -> bool:
        """Whether the data can be calibrated."""
        return not self.problems and all(camera.are_ready for camera in self.cameras)

    @property
    def are_doubtful(self) -> bool:
        """Whether anything does not fit."""
        return bool(self.doubts) or any(camera.are_doubtful for camera in self.cameras)

    def without_doubts(self, texts: Collection[str]) -> "Findings":
        """Return the findings without some doubts."""
        doubts = [text for text in self.doubts if text not in texts]
        return self._replace(doubts=doubts, document=self.document | {"doubts": doubts})

    def print(self) -> None:
        """Print what was found, problems and doubts last."""
        print_lines(*self.lines)
        for camera in self.cameras:
            camera.print()
        for kind, texts in (("problem", self.problems), ("doubt", self.doubts)):
            print_lines(*(f"{kind}: {text}" for text in texts))


def _checked(
    given: "sv.Dataset",
    name: str,
    camera: "sv.Camera | None",
    reference: str | None = None,
    stops: tuple[str, ...] = (),
) -> Findings:
    """Check the data of one camera, which may be known.

    Of a known camera one or two views suffice if a reference, another camera of the rig, tells
    where the target is. What stops `smartview calibrate` from loading the data comes first.
    """
    data = _without_repetitions(given)
    figures = _figures(data)
    first = f"{name}: {data.view_count} views, {data.mount}"
    lines = [first, *data.notes, *_seen(figures, data)]
    if camera is not None and reference is not None and 0 < figures.usable_views < 3:
        lines.append(
            f"usable views: {figures.usable_views}; its place follows from the target that "
            f"{reference} sees"
        )
        problems, doubts, staged = (), (), None
    else:
        lines += _motion(figures) if data.hands is None else _motions_of_hands(data, data.hands)
        # The data with repetitions: if all poses are equal, no view is left without them.
        reported = {view for view, _ in data.masked_views}
        problems, doubts, staged = _agreement(given, reported, camera)
    problems = (*stops, *problems)
    document = _document(name, data, figures, problems, doubts)
    return Findings(lines, problems, doubts, document, staged)


def _checked_rig(
    rig: "sv.Rig", name: str, known: "Mapping[str, sv.Camera]", stops: tuple[str, ...]
) -> Findings:
    """Check the data of several cameras, after what stops `smartview calibrate`."""
    from ..rig_pipeline import (
        doubts_told_by_others,
        reference_camera,
        shared_target_findings,
        usable_view_counts,
    )

    counts = {c: n for c, n in usable_view_counts(rig, known).items() if n >= 3}
    cameras = {
        camera: _checked(data, camera, known.get(camera), reference_camera(rig, camera, counts))
        for camera, data in rig.cameras.items()
    }
    shared = sum(len(seeing) > 1 for seeing in rig.seeing)
    staged = {name: each.staged for name, each in cameras.items() if each.staged is not None}
    for camera, texts in doubts_told_by_others(rig, staged).items():
        cameras[camera] = cameras[camera].without_doubts(texts)
    together = shared_target_findings(rig, staged)
    problems, doubts = [*stops, *together.problems], [*together.doubts, *_lonely_cameras(rig)]
    arms = rig.robot_names
    robots = "the robot" if len(arms) == 1 else f"the arms {', '.join(arms)}"
    line = (
        f"{name}: {len(cameras)} cameras, {rig.view_count} states of {robots}, {shared} of them "
        "seen by several cameras"
    )
    document = {
        "data_set": name,
        "states": rig.view_count,
        "states_seen_by_several": shared,
        "cameras": {camera: each.document for camera, each in cameras.items()},
        "problems": problems,
        "doubts": doubts,
    }
    findings = Findings([line], problems, doubts, document, cameras=list(cameras.values()))
    document["can_be_calibrated"] = findings.are_ready
    return findings


def _lonely_cameras(rig: "sv.Rig") -> list[str]:
    """Return a doubt for each camera that shares neither a state nor a target with another."""
    if len(rig.cameras) == 1:
        return []
    together = {camera for cameras in rig.seeing if len(cameras) > 1 for camera in cameras}
    targets = list(rig.targets.values())
    return [
        f"camera {name} shares no state of the robot and no target with another camera: only the "
        "robot's errors connect them"
        for name, target in rig.targets.items()
        if name not in together and targets.count(target) == 1
    ]


def _without_repetitions(data: "sv.Dataset") -> "sv.Dataset":
    """Return the data without views that repeat others, with the reason for each."""
    reasons = sv.dataset.repeated_views(data)
    masked = [(data.view_ids[view], text) for view, text in reasons.items()]
    return dataclasses.replace(
        data.mask_views(list(reasons)), masked_views=(*data.masked_views, *masked)
    )


def _figures(data: "sv.Dataset") -> DatasetFigures:
    """Count the points, the covered part of the picture and the extent of the robot's motion."""
    visible = np.asarray(data.visible)
    counts = visible.sum(axis=1)
    pixels, picture_used = np.asarray(data.pixels)[visible], None
    if len(pixels):
        # Cells of an 8 x 8 grid.
        cells = np.floor(8 * pixels / np.array(data.image_size)).clip(0, 7).astype(int)
        picture_used = len(np.unique(cells, axis=0)) / 64
    # Plain numbers, because json cannot write NumPy's.
    points = (int(counts.min()), int(counts.max()), float(np.median(counts)))
    used = data.usable_views()
    if len(used) < 2:
        return DatasetFigures(points, picture_used, len(used), None, None)
    poses = sv.geometry.host_matrices(data.base_from_tool)[used]
    largest = float(sv.geometry.host_pairwise_rotation_angles(poses, poses).max())
    extent = tuple(np.ptp(poses[:, :3, 3], axis=0).tolist())
    one_axis = sv.dataset.turns_about_one_axis(poses)
    return DatasetFigures(points, picture_used, len(used), extent, largest, one_axis)


def _seen(figures: DatasetFigures, data: "sv.Dataset") -> list[str]:
    """Return the detections in words: points by view, views left out, share of the picture used."""
    least, greatest, median = figures.points
    lines = [f"points seen in a view: {least} to {greatest}, median {median:.0f}"]
    lines += [f"  view {view} is left out: {reason}" for view, reason in data.masked_views]
    if figures.picture_used is not None:
        advice = ": move the target to the borders too" if figures.picture_used < MIN_FILLED else ""
        lines.append(f"part of the picture covered by points: {figures.picture_used:.0%}{advice}")
    return lines


def _motion(figures: DatasetFigures) -> list[str]:
    """Return in words how far the robot moved and turned between the views."""
    if figures.extent is None or figures.largest_rotation is None:
        return [f"usable views: {figures.usable_views}; take more"]
    largest = math.degrees(figures.largest_rotation)
    advice = ""
    if figures.one_axis:
        advice = (
            "; all rotations share one axis, so the camera's position along it cannot be found: "
            "turn the tool about another axis too"
        )
    elif largest < MIN_TURN:
        advice = "; turn the tool more"
    more = "; take more" if figures.usable_views < MIN_VIEWS else ""
    extent_mm = [1e3 * x for x in figures.extent]
    return [
        f"usable views: {figures.usable_views}{more}",
        f"the tool moved by {sv.geometry.vector_text(extent_mm, 0)} mm along x, y, z",
        f"largest rotation between two views: {largest:.0f} degrees{advice}",
    ]


def _motions_of_hands(data: "sv.Dataset", hands: "sv.robots.HandPoses") -> list[str]:
    """Return in words how far each of two hands moved and turned between the views."""
    lines = [f"usable views: {len(data.usable_views())}"]
    for name, poses in (
        ("camera", hands.base_from_tool),
        ("target", hands.other_base_from_other_tool),
    ):
        alone = dataclasses.replace(data, base_from_tool=poses, hands=None)
        lines += [f"hand with the {name}: {text}" for text in _motion(_figures(alone))[1:]]
    return lines


def _document(
    name: str,
    data: "sv.Dataset",
    figures: DatasetFigures,
    problems: Sequence[str],
    doubts: Sequence[str],
) -> dict[str, Any]:
    least, greatest, median = figures.points
    extent, rotation = figures.extent, figures.largest_rotation
    return {
        "data_set": name,
        "mount": data.mount,
        "views": data.view_count,
        "usable_views": figures.usable_views,
        "left_out_views": views_left_out(data.masked_views),
        "points_per_view": {"least": least, "greatest": greatest, "median": median},
        "picture_used": figures.picture_used,
        "tool_extent_mm": None if extent is None else [1e3 * x for x in extent],
        "largest_rotation_deg": None if rotation is None else math.degrees(rotation),
        "turns_about_one_axis": figures.one_axis,
        "notes": list(data.notes),
        "problems": list(problems),
        "doubts": list(doubts),
        # The exit code says the same.
        "can_be_calibrated": not problems,
    }


def _agreement(
    data: "sv.Dataset", reported: Collection[str], camera: "sv.Camera | None"
) -> "tuple[Sequence[str], Sequence[str], sv.StagedFit | None]":
    """Return problems, doubts about views not reported yet, and the staged fit they are from."""
    try:
        # As in `calibrate`, so that data are refused for the same reasons.
        if camera is not None:
            sv.dataset.require_picture_size("--camera", camera, data.image_size)
        lens = "opencv4" if camera is None else camera.lens
        fit = sv.fit_staged(data, lens, camera=camera, conventions="report")
    except ValueError as error:
        return (str(error),), (), None
    problems = fit.conventions.problems
    reasons = {data.view_ids[view]: text for view, text in fit.conventions.suspicious_views}
    # Where robot and camera do not move alike, every view's disagreement is a consequence.
    reasons |= {
        view: f"calibrate leaves it out: {reason}"
        for view, point, reason in fit.rejected
        if point is None and not problems
    }
    doubts = [f"view {view}: {text}" for view, text in reasons.items() if view not in reported]
    if not problems and not fit.conventions.change:
        # A wrong pose moves by some other length than the camera did.
        report = _report_without_doubted_views(data, fit) if reasons else fit.conventions
        # The fit has asked for other causes of inaccurate poses, and warns where it found none.
        report = report._replace(inaccuracy=fit.conventions.inaccuracy)
        doubts += _doubts_of_motion(report, camera is not None, data.joints is not None)
    doubts += [text for text in fit.warnings if text not in problems]
    return problems, doubts, fit


def _report_without_doubted_views(
    data: "sv.Dataset", fit: "sv.StagedFit"
) -> "sv.data_checks.ConventionReport":
    """Return how robot and camera move in the views that are neither left out nor suspicious."""
    if fit.calibration.base_from_other_base is not None:
        data = data.with_bases(fit.calibration.base_from_other_base)
    weights = np.zeros(data.view_count)
    weights[list(fit.views)] = 1.0
    weights[[view for view, _ in fit.conventions.suspicious_views]] = 0.0
    return sv.data_checks.check_conventions(
        data.base_from_tool, fit.step2.camera_from_world, data.mount, weights
    )


def _doubts_of_motion(
    report: "sv.data_checks.ConventionReport", camera_is_known: bool, by_joints: bool
) -> list[str]:
    """Return what is doubtful about the motions of robot and camera, though they are alike."""
    ratio, std = report.length_ratio, report.length_ratio_std
    is_other_size = not 1.0 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO
    if is_other_size and abs(ratio - 1.0) > 2.0 * std:
        size = f"is the target {1.0 / ratio:.3g} times as large as stated? measure it"
        if camera_is_known:
            size = f"is the known camera's focal length {ratio:.3g} times the true one, or {size}"
        cause = sv.data_checks.mistaken_unit(ratio) or size
        return [
            f"the camera moves {ratio:.3g} times as far as the robot says: {cause}"
            + (f"; {sv.data_checks.OTHER_ARM_TEXT}" if by_joints else "")
        ]
    rotation, translation = report.closure_error
    if report.is_close or report.inaccuracy:
        return []
    return [
        f"robot and camera agree only to {math.degrees(rotation):.2g} degrees and "
        f"{1e3 * translation:.3g} mm between two views (median): a good arm leaves a tenth of that"
    ]
