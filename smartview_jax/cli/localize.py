"""Define `smartview localize`, which finds known objects in calibrated pictures."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import smartview_jax as sv

from ..argument_checks import errors_at
from ..files import refuse_unwritable
from .documents import print_document, transform_document
from .load import RigOptions, load_calibrated_views, load_views
from .options import DebugOption, JsonOption, parse_numbers, with_option_groups
from .terminal import errors_reported, print_lines, progress_line


@dataclass(frozen=True)
class SearchOptions:
    """The objects that are searched for, and what is known of the place where they are."""

    models: Annotated[
        list[Path],
        typer.Argument(
            help="Object models (smartview model); each object may occur several times."
        ),
    ]
    workspace: Annotated[
        str | None,
        typer.Option(
            help="Box that contains the objects: two opposite corners, x,y,z,x,y,z in m in the "
            "target's frame, such as -0.2,-0.2,0,0.2,0.2,0.15; by default unlimited."
        ),
    ] = None
    occluder: Annotated[
        list[Path] | None,
        typer.Option(
            help="Mesh of an obstacle, m in the target's frame, such as bin.stl (or .obj, .ply): "
            "edges that it occludes do not count as missing. May be repeated."
        ),
    ] = None

    def corners(self) -> np.ndarray | None:
        """Return two opposite corners of the workspace box; raise a ValueError for other texts."""
        if self.workspace is None:
            return None
        corners = parse_numbers("--workspace", self.workspace, 6, "x,y,z,x,y,z (m)")
        return np.array(corners).reshape(2, 3)

    def triangles(self) -> np.ndarray | None:
        """Return the triangles of the obstacles in the world."""
        if not self.occluder:
            return None
        triangles = [
            np.asarray(sv.io.to_trimesh(sv.io.read_mesh(p)).triangles) for p in self.occluder
        ]
        return np.concatenate(triangles)


@with_option_groups
def localize(
    calibration: Annotated[
        Path,
        typer.Argument(help="A calibration.yaml, or the folder of a calibrated rig."),
    ],
    views: Annotated[Path, typer.Argument(help="Folder with pictures and the robot's poses.")],
    *,
    search: SearchOptions,
    rig: RigOptions,
    out: Annotated[
        Path | None,
        typer.Option(help="A page with wireframes over the pictures, such as found.html."),
    ] = None,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Find known objects in calibrated pictures, and say how certain each is.

    Each object is accepted, rejected or open, with the reasons. The exit code is 1 if none is
    accepted. Use two views or more: from one view the distance to an object is uncertain.
    """
    with errors_reported(debug):
        # Options are checked before the pictures are searched, which takes long.
        if out is not None:
            refuse_unwritable(out.parent, "--out")
        corners, triangles = search.corners(), search.triangles()
        models = search.models
        objects = [sv.io.load_object_model(path) for path in models]
        seen = load_views(views)
        names, paths, command = seen.names, seen.pictures, seen.command
        loaded, estimate, is_exact = load_calibrated_views(calibration, seen, rig)
        cameras = sv.modeling.SeenViews.of(loaded, command).cameras
        with progress_line() as progress:
            pictures = [
                sv.detection.read_picture(path, camera.image_size)
                for path, camera in zip(paths, cameras, strict=True)
            ]
            evidence = _evidence(pictures, paths, cameras, progress)
            progress("searching")
            localizations = sv.localize(
                evidence,
                command,
                loaded,
                objects,
                covariance=estimate,
                workspace=corners,
                occluders=triangles,
            )
        # The table comes before the page, which takes seconds to draw.
        if not json:
            _print(localizations)
            print_lines(sv.report.localization_verdict(localizations))
            if is_exact:
                print_lines(f"{calibration} has no covariance: taken as exact")
        if out is not None:
            title = f"{', '.join(path.stem for path in models)} in {views.resolve().name}"
            sv.report.write_localization_page(out, title, loaded, localizations, pictures, names)
        if json:
            content = {
                "views": names,
                "frame": rig.frame,
                "objects": [_document(localization, models) for localization in localizations],
                "messages": localizations.messages,
                "page": out,
            }
            print_document("localize", content)
        elif out is not None:
            typer.echo(f"{out}: the pictures")
        # A script learns from the exit code that there is nothing to grasp.
        if not localizations.accepted:
            raise typer.Exit(1)


def _evidence(
    pictures: Sequence[np.ndarray],
    paths: Sequence[Path],
    cameras: "Sequence[sv.Camera]",
    progress: Callable[[str], None],
) -> "list[sv.features.PictureEvidence]":
    """Return the edges found in each picture; an error begins with the picture's name."""
    evidence = []
    for k, (picture, path, camera) in enumerate(zip(pictures, paths, cameras, strict=True)):
        progress(f"edges: picture {k + 1} of {len(paths)}")
        with errors_at(path):
            evidence.append(sv.features.picture_evidence(picture, camera))
    return evidence


def _print(localizations: "sv.localization.Localizations") -> None:
    """Print the table, and the messages about rejected objects."""
    rows = [list(sv.report.LOCALIZATION_HEADINGS), *sv.report.localization_rows(localizations)]
    # Without any object the messages say so; a table of headings alone would not help.
    if len(rows) > 1:
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        for row in rows:
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            typer.echo("  ".join(cells).rstrip())
    print_lines(*localizations.messages)


def _document(localization: "sv.Localization", models: Sequence[Path]) -> dict[str, Any]:
    """Return a localised object as values for programs."""
    evidence = localization.verdict.evidence
    return {
        "model": models[localization.model_index],
        "name": localization.model.name,
        "verdict": localization.verdict.decision,
        "reasons": localization.verdict.reasons,
        "world_from_object": transform_document(
            sv.geometry.host_transforms(localization.world_from_object)
        ),
        # In the tangent space at the object, translation first.
        "covariance": localization.covariance,
        "equivalent_poses": len(localization.equivalent_poses),
        "explained_share": evidence.explained,
        "explained_share_by_view": evidence.explained_in_view,
        "measured_edges": evidence.edges,
        "edge_rms_px": evidence.edge_rms,
        "log10_false_alarms": localization.verdict.log_false_alarms,
        "log_likelihood_margin": localization.verdict.margin,
        "rivals": [
            {
                "model": models[rival.model],
                "world_from_object": transform_document(
                    sv.geometry.host_transforms(rival.world_from_object)
                ),
                "log_odds": rival.log_odds,
            }
            for rival in localization.rivals
        ],
    }
