"""Define `smartview evaluate`, which predicts pictures that a calibration was not fitted to."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

import smartview_jax as sv

from ..argument_checks import errors_at
from ..files import read_yaml, refuse_unwritable
from . import options
from .documents import errors_document, print_document, views_left_out
from .load import load_named
from .options import with_option_groups
from .terminal import errors_reported, print_lines, print_table, progress_line


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
        several = sv.io.is_rig_folder(new.dataset)
        if several and (compare or out is not None):
            raise ValueError(f"--compare, --out: not for several cameras, which {new.dataset} has")
        if several and not calibration.is_dir():
            raise ValueError(
                f"{calibration}: expected the folder with a calibration of each camera, such as "
                f"{calibration.parent}, because {new.dataset} has several cameras"
            )
        if out is not None:
            refuse_unwritable(out.parent, "--out")
        with progress_line() as progress:
            if several:
                rig = sv.load_rig(new.dataset, new.bad_views, progress)
                name, names = new.dataset.resolve().name, list(rig.cameras)
                datasets = list(rig.cameras.values())
                paths = [calibration / f"{camera}.yaml" for camera in names]
                loaded = map(sv.joint.load_with_uncertainty, paths)
            else:
                paths = [calibration, *(compare or [])]
                names = [path.stem for path in paths]
                loaded = [sv.joint.load_with_uncertainty(path) for path in paths]
                data, name = load_named(new.dataset, new.bad_views, progress)
                datasets = [data] * len(paths)
            predictions = [
                Prediction.of(*given, new.moved)
                for given in zip(names, paths, loaded, datasets, strict=True)
            ]
        judged = predictions if several else predictions[:1]
        verdict = "\n".join(prediction.verdict(name) for prediction in judged)
        # People see the figures before the page is drawn, which takes seconds.
        rows = _rows(predictions)
        if not json:
            _print(rows, judged, verdict)
        if out is not None:
            title = f"{calibration.name} on {name}"
            summaries = [prediction.summary for prediction in predictions]
            first = predictions[0]
            sv.report.write_evaluation_page(
                out, title, verdict, first.calibration, first.data, summaries, rows
            )
        if json and several:
            entries = [prediction.document() | prediction.views() for prediction in predictions]
            print_document("evaluate", {"data_set": name, "cameras": entries})
        elif json:
            entries = [prediction.document() for prediction in predictions]
            content = {"data_set": name, "calibrations": entries, "page": out}
            print_document("evaluate", content | predictions[0].views())
        elif out is not None:
            typer.echo(f"{out}: the figures")


@dataclass(frozen=True)
class Prediction:
    """The errors with which a calibration predicts new pictures.

    Attributes:
        summary: name of the calibration, and the errors.
        calibration: the calibration, whose target may have been found again.
        expected: errors that the calibration's covariance predicts; None without a covariance.
        fitted_views: names of the views whose pictures the calibration was fitted to.
    """

    summary: "sv.report.ErrorSummary"
    path: Path
    calibration: "sv.Calibration"
    data: "sv.Dataset"
    expected: "sv.evaluation.ReprojectionErrors | None"
    fitted_views: list[str]

    @classmethod
    def of(
        cls,
        name: str,
        path: Path,
        loaded: "tuple[sv.Calibration, sv.joint.SavedEstimate | None]",
        data: "sv.Dataset",
        moved: bool,
    ) -> "Prediction":
        """Return the prediction of a data set, whose target may have been moved."""
        (calibration, estimate), expected = loaded, None
        with errors_at(path):
            sv.dataset.require_same_set_up("the calibration", calibration, data)
        if moved:
            # The target's pose is refitted to the pictures, all else held.
            held = ("camera", calibration.transform_names[0])
            calibration = sv.fit_joint(data, calibration, noise="trusted", fixed=held).calibration
        elif estimate is not None:
            expected = sv.evaluation.expected_reprojection_errors(estimate, data)
        errors = sv.evaluation.reprojection_errors(calibration, data)
        used = set(read_yaml(path).get("pictures") or ())
        digests = zip(data.view_ids, sv.dataset.picture_digests(data), strict=True)
        fitted = [view for view, digest in digests if digest in used]
        summary = sv.report.ErrorSummary(name, errors, None)
        return cls(summary, path, calibration, data, expected, fitted)

    def verdict(self, name: str) -> str:
        """Return the result in a sentence, and a second one about pictures that are not new."""
        errors, data, fitted = self.summary.reprojection_errors, self.data, self.fitted_views
        text = (
            f"{self.summary.name} predicts the target in {name} to {errors.rms:.2f} px RMS, "
            f"{errors.rms_mm:.2f} mm at the target."
        )
        if not fitted:
            return text
        names = "" if len(fitted) == data.view_count else f" ({', '.join(fitted)})"
        return (
            f"{text}\n{len(fitted)} of {data.view_count} pictures{names} were used to fit this "
            "calibration: the error on new pictures is larger. Take new ones, or see the held-out "
            "errors of smartview calibrate."
        )

    def document(self) -> dict[str, Any]:
        """Return the figures for programs, also by view."""
        errors, expected = self.summary.reprojection_errors, self.expected
        rms_by_view = zip(self.data.view_ids, errors.rms_per_view.tolist(), strict=True)
        return {
            "file": self.path,
            "name": self.summary.name,
            **errors_document(errors),
            "rms_interval_95_px": list(sv.evaluation.rms_interval(errors)),
            # As the calibration's covariance predicts; `over_expected` is ideally 1.
            "expected_rms_px": None if expected is None else expected.rms,
            "over_expected": None if expected is None else errors.rms / expected.rms,
            # A view without points has NaN, which JSON writes as null.
            "rms_by_view_px": dict(rms_by_view),
        }

    def views(self) -> dict[str, Any]:
        """Return the views that are not new, and those left out, for programs."""
        left_out = views_left_out(self.data.masked_views)
        return {"fitted_views": self.fitted_views, "left_out_views": left_out}

    def column(self) -> list[str]:
        """Return the figures as a column of the table."""
        errors, expected = self.summary.reprojection_errors, self.expected
        low, high = sv.evaluation.rms_interval(errors)
        views = int((errors.px == errors.px).any(axis=1).sum())
        return [
            self.summary.name,
            f"{errors.mean:.2f} +- {errors.std:.2f} px",
            f"{errors.rms:.2f} px",
            f"{low:.2f} to {high:.2f} px",
            f"{errors.rms_mm:.2f} mm",
            "-" if expected is None else f"{errors.rms / expected.rms:.2f}",
            f"{self.data.observation_count}, {views}",
            f"{errors.unpredicted_count}",
        ]


_MEASURES = (
    "",
    "mean +- std",
    "RMS",
    "  95 % interval over views",
    "  at the target",
    "  actual / predicted error (ideal: 1)",
    "points, views",
    "points that cannot be predicted",
)


def _rows(predictions: Sequence[Prediction]) -> list[list[str]]:
    """Return the table, one column for each calibration, with the measures' names first."""
    columns = (_MEASURES, *(prediction.column() for prediction in predictions))
    return [list(row) for row in zip(*columns, strict=True)]


def _print(rows: Sequence[Sequence[str]], judged: Sequence[Prediction], verdict: str) -> None:
    """Print the table of figures, the views left out, and the result in a sentence."""
    print_table(rows[0], rows[1:], "right", box=None, pad_edge=False)
    masked = (entry for prediction in judged for entry in prediction.data.masked_views)
    for view, reason in dict(masked).items():
        print_lines(f"view {view} is left out: {reason}")
    print_lines(verdict)
