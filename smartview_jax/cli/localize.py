"""Define `smartview localize`, which finds known objects in calibrated pictures."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .json_document import print_document, transform_document
from .load import load_views
from .options import DebugOption, JsonOption
from .terminal import errors_reported, progress_line

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np

    from ..cameras import Camera
    from ..features import PictureEvidence
    from ..localization import Localization, Localizations


def localize(
    calibration: Annotated[Path, typer.Argument(help="A calibration.yaml.")],
    views: Annotated[Path, typer.Argument(help="Folder with pictures and the robot's poses.")],
    models: Annotated[
        list[Path],
        typer.Argument(help="Object models (smartview model): any number of each may be there."),
    ],
    workspace: Annotated[
        str | None,
        typer.Option(
            help="Two opposite corners of the box in which objects are, x,y,z,x,y,z in m in the "
            "target's frame; by default they may be anywhere."
        ),
    ] = None,
    occluder: Annotated[
        list[Path] | None,
        typer.Option(
            help="A mesh (.stl, .obj, .ply) in m in the target's frame of what stands there, such "
            "as a bin: what it hides is not held against an object."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="A page with wireframes over the pictures, such as found.html."),
    ] = None,
    json: JsonOption = False,
    debug: DebugOption = False,
) -> None:
    """Find known objects in calibrated pictures, and say how certain each is.

    An object is accepted, rejected or open, with the reasons. The exit code is 1 if none is
    accepted. Two views or more are best: one leaves an object's distance uncertain.
    """
    with errors_reported(debug):
        from .. import localization
        from ..detection import read_picture
        from ..files import refuse_unwritable
        from ..io import load_object_model
        from ..joint import load_with_uncertainty
        from ..report import localization_verdict, write_localization_page

        # All that can be refused is refused before the pictures are searched.
        if out is not None:
            refuse_unwritable(out.parent, "--out")
        corners, triangles = _corners(workspace), _triangles(occluder)
        loaded, estimate = load_with_uncertainty(calibration)
        objects = [load_object_model(path) for path in models]
        names, paths, command = load_views(views)
        with progress_line() as progress:
            pictures = [read_picture(path, loaded.camera.image_size) for path in paths]
            evidence = _evidence(pictures, paths, loaded.camera, progress)
            progress("searching")
            found = localization.localize(
                evidence,
                command,
                loaded,
                objects,
                covariance=estimate,
                workspace=corners,
                occluders=triangles,
            )
        # People see the table before the page is drawn, which takes seconds.
        if not json:
            _print(found)
            typer.echo(localization_verdict(found))
            if estimate is None:
                typer.echo(f"{calibration} says nothing of its uncertainty: taken as exact")
        if out is not None:
            title = f"{', '.join(path.stem for path in models)} in {views.resolve().name}"
            write_localization_page(out, title, loaded, found, pictures, names)
        if json:
            content = {
                "views": names,
                "objects": [_document(one, models) for one in found],
                "messages": found.messages,
                "page": out,
            }
            print_document("localize", content)
        elif out is not None:
            typer.echo(f"{out}: the pictures")
        # A script learns from the exit code that there is nothing to grasp.
        if not found.accepted:
            raise typer.Exit(1)


def _corners(workspace: str | None) -> "np.ndarray | None":
    """Return two opposite corners of the box of an option.

    Raises:
        ValueError: not six finite numbers.
    """
    import numpy as np

    if workspace is None:
        return None
    try:
        numbers = np.array([float(word) for word in workspace.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        raise ValueError(
            "--workspace: expected six numbers between commas, x,y,z,x,y,z (m), "
            f"found {workspace!r}"
        )
    return numbers.reshape(2, 3)


def _triangles(meshes: list[Path] | None) -> "np.ndarray | None":
    """Return the triangles of meshes in the world."""
    import numpy as np

    from ..io import read_mesh, to_trimesh

    if not meshes:
        return None
    try:
        found = [np.asarray(to_trimesh(read_mesh(path)).triangles) for path in meshes]
    except ImportError as error:
        # An extra that is not installed is for the user to install, not a fault to trace.
        raise ValueError(str(error)) from error
    return np.concatenate(found)


def _evidence(
    pictures: "Sequence[np.ndarray]",
    paths: "Sequence[Path]",
    camera: "Camera",
    progress: "Callable[[str], None]",
) -> "list[PictureEvidence]":
    """Return what is found in each picture; an error begins with the picture's name."""
    from ..features import picture_evidence

    found = []
    for k, (picture, path) in enumerate(zip(pictures, paths, strict=True)):
        progress(f"edges: picture {k + 1} of {len(paths)}")
        try:
            found.append(picture_evidence(picture, camera))
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
    return found


def _print(found: "Localizations") -> None:
    """Print the table, and why the others were not accepted."""
    from ..report import LOCALIZATION_HEADINGS, localization_rows

    rows = [list(LOCALIZATION_HEADINGS), *localization_rows(found)]
    # Where nothing was found the messages say so, and headings alone say nothing.
    if len(rows) > 1:
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        for row in rows:
            cells = [cell.ljust(width) for cell, width in zip(row, widths, strict=True)]
            typer.echo("  ".join(cells).rstrip())
    for text in found.messages:
        typer.echo(text)


def _document(one: "Localization", models: "Sequence[Path]") -> dict[str, Any]:
    """Return what was found of an object, for programs."""
    from ..geometry import host_transforms

    evidence = one.verdict.evidence
    return {
        "model": models[one.model_index],
        "name": one.model.name,
        "verdict": one.verdict.decision,
        "reasons": one.verdict.reasons,
        "world_from_object": transform_document(host_transforms(one.world_from_object)),
        # Of the tangent at the object, translation first.
        "covariance": one.covariance,
        "equivalent_poses": len(one.equivalent_poses),
        "explained_share": evidence.explained,
        "explained_share_by_view": evidence.explained_in_view,
        "measured_edges": evidence.edges,
        "edge_rms_px": evidence.edge_rms,
        "log10_false_alarms": one.verdict.log_false_alarms,
        "log_likelihood_margin": one.verdict.margin,
        "rivals": [
            {
                "model": models[rival.model],
                "world_from_object": transform_document(host_transforms(rival.world_from_object)),
                "log_odds": rival.log_odds,
            }
            for rival in one.rivals
        ],
    }
