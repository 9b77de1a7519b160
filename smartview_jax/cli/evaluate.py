"""Define `smartview evaluate`, which predicts pictures that a calibration was not fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

import smartview_jax as sv

from ..files import read_yaml, refuse_unwritable
from . import options
from .documents import errors_document, print_document, views_left_out
from .load import load_named
from .options import with_option_groups
from .terminal import errors_reported, progress_line


@dataclass(frozen=True)
class NewPictures:
    """The pictures that are predicted, and what is known of them."""

    dataset: Annotated[Path, typer.Argument(help="Data-set folder with new pictures and poses.")]
    moved: Annotated[
        bool,
        typer.Option(
            "--moved", help="The target was moved: estimate its pose from the new pictures."
        ),
    ] = False
    bad_views: options.BadViewsOption = options.BadViews.MASK


@with_option_groups
def evaluate(
    calibration: Annotated[
        Path,
        typer.Argument(
            help="A calibration.yaml; for a folder with several cameras, the folder of theirs."
        ),
    ],
    *,
    new: NewPictures,
    compare: Annotated[
        list[Path] | None,
        typer.Option(
            help="Another calibration to compare with the first, such as old/calibration.yaml. May "
            "be repeated."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="A page with the figures, such as evaluation.html.")
    ] = None,
    json: options.JsonOption = False,
    debug: options.DebugOption = False,
) -> None:
    """Predict new pictures of the target from the robot's poses alone, and print the error.

    As in the paper's experiment, the calibration must not have been fitted to these pictures. With
    --moved only the camera and the hand-eye transform are judged.
    """
    with errors_reported(debug):
        if sv.io.is_rig_folder(new.dataset):
            if compare or out is not None:
                raise ValueError(
                    f"--compare, --out: not for several cameras, which {new.dataset} has"
                )
            _evaluate_rig(calibration, new, json)
            return
        if out is not None:
            refuse_unwritable(out.parent, "--out")
        paths = [calibration, *(compare or [])]
        with progress_line() as progress:
            loaded = [sv.joint.load_with_uncertainty(path) for path in paths]
            data, name = load_named(new.dataset, new.bad_views, progress)
            if new.moved:
                loaded = [(_with_target_found(moved_from, data), None) for moved_from, _ in loaded]
            summaries = [
                sv.report.ErrorSummary(
                    path.stem, sv.evaluation.reprojection_errors(fitted_calibration, data), None
                )
                for path, (fitted_calibration, _) in zip(paths, loaded, strict=True)
            ]
        fitted = _fitted_views(calibration, data)
        expected = [_expected(estimate, data) for _, estimate in loaded]
        rows = _rows(summaries, [data] * len(summaries), expected)
        verdict = _verdict(summaries[0], name) + _fitted_text(fitted, data)
        # People see the figures before the page is drawn, which takes seconds.
        if not json:
            _print(rows, [data], verdict)
        if out is not None:
            title = f"{calibration.name} on {name}"
            sv.report.write_evaluation_page(
                out, title, verdict, loaded[0][0], data, summaries, rows
            )
        if json:
            entries = [
                {"file": path, **_entries(summary, foreseen, data)}
                for path, summary, foreseen in zip(paths, summaries, expected, strict=True)
            ]
            content = {
                "data_set": name,
                "calibrations": entries,
                "page": out,
                "fitted_views": fitted,
            }
            left_out = {"left_out_views": views_left_out(data.masked_views)}
            print_document("evaluate", content | left_out)
        elif out is not None:
            typer.echo(f"{out}: the figures")


def _evaluate_rig(calibrations: Path, new: NewPictures, json: bool) -> None:
    """Predict new pictures of several cameras, and print the error of each.

    Args:
        calibrations: folder with a calibration of each camera, named after it.
        new: pictures of several cameras.
        json: whether to print a document for programs.
    """
    with progress_line() as progress:
        rig = sv.load_rig(new.dataset, new.bad_views, progress)
        summaries, expected, files, fitted = [], [], [], {}
        for name, data in rig.cameras.items():
            files.append(calibrations / f"{name}.yaml")
            calibration, estimate = sv.joint.load_with_uncertainty(files[-1])
            if new.moved:
                calibration, estimate = _with_target_found(calibration, data), None
            summaries.append(
                sv.report.ErrorSummary(
                    name, sv.evaluation.reprojection_errors(calibration, data), None
                )
            )
            expected.append(_expected(estimate, data))
            fitted[name] = _fitted_views(files[-1], data)
    cameras, name = list(rig.cameras.values()), new.dataset.resolve().name
    if json:
        entries = [
            {
                "file": file,
                **_entries(summary, foreseen, data),
                "fitted_views": fitted[summary.name],
                "left_out_views": views_left_out(data.masked_views),
            }
            for file, summary, foreseen, data in zip(
                files, summaries, expected, cameras, strict=True
            )
        ]
        print_document("evaluate", {"data_set": name, "cameras": entries})
        return
    texts = [
        _verdict(summary, name) + _fitted_text(fitted[summary.name], data)
        for summary, data in zip(summaries, cameras, strict=True)
    ]
    _print(_rows(summaries, cameras, expected), cameras, "\n".join(texts))


def _print(rows: Sequence[Sequence[str]], datasets: "Sequence[sv.Dataset]", verdict: str) -> None:
    """Print the table of figures, the views left out, and the result in a sentence."""
    for row in rows:
        typer.echo(f"{row[0]:40}" + "".join(f"{cell:>20}" for cell in row[1:]))
    for view, reason in dict(entry for data in datasets for entry in data.masked_views).items():
        typer.echo(f"view {view} is left out: {reason}")
    typer.echo(verdict)


def _entries(
    summary: "sv.report.ErrorSummary",
    expected: "sv.evaluation.ReprojectionErrors | None",
    data: "sv.Dataset",
) -> dict[str, Any]:
    """Return the figures of one calibration for programs, also by view."""
    errors = summary.reprojection_errors
    return {
        "name": summary.name,
        **errors_document(errors),
        "rms_interval_95_px": list(sv.evaluation.rms_interval(errors)),
        # As the calibration's covariance predicts; `over_expected` is ideally 1.
        "expected_rms_px": None if expected is None else expected.rms,
        "over_expected": None if expected is None else errors.rms / expected.rms,
        # A view without points has NaN, which JSON writes as null.
        "rms_by_view_px": dict(zip(data.view_ids, errors.rms_per_view.tolist(), strict=True)),
    }


def _fitted_views(calibration: Path, data: "sv.Dataset") -> list[str]:
    """Return the names of the views whose pictures the calibration was fitted to."""
    fitted = set(read_yaml(calibration).get("pictures") or ())
    digests = sv.dataset.picture_digests(data)
    return [view for view, digest in zip(data.view_ids, digests, strict=True) if digest in fitted]


def _fitted_text(fitted: Sequence[str], data: "sv.Dataset") -> str:
    """Return a sentence about pictures that are not new to the calibration; empty without any."""
    if not fitted:
        return ""
    names = "" if len(fitted) == data.view_count else f" ({', '.join(fitted)})"
    return (
        f"\n{len(fitted)} of {data.view_count} pictures{names} were used to fit this calibration: "
        "the error on new pictures is larger. Take new ones, or see the held-out errors of "
        "smartview calibrate."
    )


def _with_target_found(calibration: "sv.Calibration", data: "sv.Dataset") -> "sv.Calibration":
    """Return the calibration with the target's pose refitted to the pictures, all else held."""
    held = ("camera", calibration.transform_names[0])
    return sv.fit_joint(data, calibration, noise="trusted", fixed=held).calibration


def _expected(
    estimate: "sv.joint.SavedEstimate | None", data: "sv.Dataset"
) -> "sv.evaluation.ReprojectionErrors | None":
    """Return the errors that the calibration's covariance predicts; None without a covariance."""
    return None if estimate is None else sv.evaluation.expected_reprojection_errors(estimate, data)


def _rows(
    summaries: "Sequence[sv.report.ErrorSummary]",
    datasets: "Sequence[sv.Dataset]",
    expected: "Sequence[sv.evaluation.ReprojectionErrors | None]",
) -> list[list[str]]:
    """Return the table, one column for each calibration, with the measures' names first."""
    columns = [
        [
            "",
            "mean +- std",
            "RMS",
            "  95 % interval over views",
            "  at the target",
            "  actual / predicted error (ideal: 1)",
            "points, views",
            "points that cannot be predicted",
        ]
    ]
    for summary, data, foreseen in zip(summaries, datasets, expected, strict=True):
        errors = summary.reprojection_errors
        low, high = sv.evaluation.rms_interval(errors)
        views = int((errors.px == errors.px).any(axis=1).sum())
        columns.append(
            [
                summary.name,
                f"{errors.mean:.2f} +- {errors.std:.2f} px",
                f"{errors.rms:.2f} px",
                f"{low:.2f} to {high:.2f} px",
                f"{errors.rms_mm:.2f} mm",
                "-" if foreseen is None else f"{errors.rms / foreseen.rms:.2f}",
                f"{data.observation_count}, {views}",
                f"{errors.unpredicted_count}",
            ]
        )
    return [list(row) for row in zip(*columns, strict=True)]


def _verdict(summary: "sv.report.ErrorSummary", name: str) -> str:
    """Return the result in a sentence."""
    errors = summary.reprojection_errors
    return (
        f"{summary.name} predicts the target in {name} to {errors.rms:.2f} px RMS, "
        f"{errors.rms_mm:.2f} mm at the target."
    )
