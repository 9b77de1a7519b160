"""Tell a run of the demo in pictures and numbers: the sections of its page, including Fig. 8."""

import numpy as np

from ..geometry import host_matrices
from ..modeling import ObjectModel
from ..plots import cropped, edge_map, with_wireframes
from ..report import Section, StoryFigure
from ..robots import Command
from .calibrating import CellCalibration
from .looking import Look, Region
from .pick import Pick

BORDER = 25.0
"""Border of the pictures around the region, px."""


def model_section(
    model: ObjectModel,
    pictures: list[np.ndarray],
    poses: Command,
    calibrated: CellCalibration,
) -> Section:
    """Return the part of the page on the model."""
    calibration = calibrated.fit.calibration
    views = host_matrices(calibration.camera_from_world(poses))
    figures = [
        StoryFigure(
            f"view {1 + k}",
            "the model over the picture that it was clicked in",
            with_wireframes(picture, calibration.camera, views[k], [(model, np.eye(4))]),
        )
        for k, picture in enumerate(pictures[:3])
    ]
    # An exact model has no uncertainty to report.
    sigma = model.vertex_sigma
    known = "" if sigma is None else f", known to {1e3 * float(np.median(sigma)):.2f} mm (median)"
    text = (
        f"A script clicked the corners of the {model.name} in {len(pictures)} pictures: "
        f"{len(model.vertices)} vertices{known}, {len(model.edges)} edges and "
        f"{len(model.faces)} faces."
    )
    return Section("The model", text, figures)


def localised_section(
    look: Look,
    calibrated: CellCalibration,
    region: Region,
    strip: list[tuple[str, np.ndarray]],
) -> Section:
    """Return the part of the page with Fig. 8 (a) to (f); the last picture of the strip is (f)."""
    calibration = calibrated.fit.calibration
    camera, views = (
        calibration.camera,
        host_matrices(calibration.camera_from_world(look.commands)),
    )
    corners = np.asarray(calibration.project(look.commands, region.corners)[0])
    figures = [
        StoryFigure(
            f"({'ab'[k]})",
            f"edges and features of view {1 + k}",
            cropped(edge_map(evidence), corners[k], BORDER),
        )
        for k, evidence in enumerate(look.found.pictures[:2])
    ]
    last = len(look.pictures) - 1
    objects = [(obj.model, np.asarray(obj.world_from_object)) for obj in look.found.accepted]
    # The last view is the verification view, if there is one.
    shown = {
        "the verification view" if look.verification is not None else "the last view": (
            look.pictures[last]
        ),
        "the wireframe where it was found": with_wireframes(None, camera, views[last], objects),
        "both superimposed": with_wireframes(look.pictures[last], camera, views[last], objects),
    }
    figures += [
        StoryFigure(f"({letter})", text, cropped(picture, corners[last], BORDER))
        for letter, (text, picture) in zip("cde", shown.items(), strict=True)
    ]
    # The last phase reached, wherever the run ended.
    phase, picture = strip[-1]
    figures.append(StoryFigure("(f)", f"the bin, last seen: {_phase_name(phase)}", picture))
    text = "Two views are searched for the models."
    if look.verification is not None:
        text += f" A further one verifies it. Why it was chosen: {look.verification.reason}."
    return Section("Localised, verified, grasped (Fig. 8)", text, figures)


def grasp_section(attempt: Pick, strip: list[tuple[str, np.ndarray]]) -> Section:
    """Return the part of the page with the grasp as a strip of pictures."""
    figures = [
        StoryFigure(f"{1 + k}", _phase_name(phase), picture)
        for k, (phase, picture) in enumerate(strip)
    ]
    return Section("The grasp, step by step", _sentence(attempt.outcome), figures)


def _phase_name(phase: str) -> str:
    return phase.replace("_", "-")


def _sentence(text: str) -> str:
    """Return a clause as a sentence; names in it keep their capital letters."""
    return f"{text[:1].upper()}{text[1:]}."


def numbers_section(
    attempt: Pick,
    calibrated: CellCalibration,
    model: ObjectModel,
    error: float,
    held: bool,
    times: list[tuple[str, float]],
) -> Section:
    """Return the part of the page on what happened, in numbers."""
    fit, target, look = calibrated.fit, attempt.target, attempt.look
    rows = [
        ("board pictures", str(len(calibrated.pictures))),
        ("pixel sigma of the calibration", f"{fit.pixel_sigma:.3f} px"),
        ("views of the bin", str(0 if look is None else len(look.pictures))),
        ("clicked model", f"{len(model.vertices)} vertices, {len(model.faces)} faces"),
    ]
    if target is not None:
        evidence = target.verdict.evidence
        std = 1e3 * np.sqrt(np.diagonal(target.covariance)[:3])
        rows += [
            ("verdict", target.verdict.decision),
            ("explained visible edges", f"{evidence.explained:.0%}"),
            ("stated standard deviation", f"{std[0]:.2f}, {std[1]:.2f}, {std[2]:.2f} mm"),
            ("error of the position, by the judge", f"{1e3 * error:.2f} mm"),
        ]
    if attempt.grasp is not None:
        rows += [
            ("opening, width of the object", f"{1e3 * attempt.grasp.opening:.1f} mm, "
             f"{1e3 * attempt.grasp.width:.1f} mm"),
            ("predicted probability of success", f"{attempt.grasp.success_probability:.1%}"),
            ("clearance on the way", f"{1e3 * attempt.grasp.clearance:.1f} mm"),
            ("fingers after closing", f"{1e3 * attempt.width:.1f} mm"),
        ]  # fmt: skip
    rows.append(("in the hand after the lift, by the physics", "yes" if held else "no"))
    rows += [(f"time: {name}", f"{seconds:.1f} s") for name, seconds in times]
    # Without a look only the outcome can be reported.
    if look is None:
        rows.append(("outcome", attempt.outcome))
    else:
        rows += [("views", text) for text in look.notes]
        rows += [("object", text) for text in _objects(look, attempt.considered)]
    return Section("What happened", "", (), (), rows)


def _objects(look: Look, considered: tuple[str, ...]) -> tuple[str, ...]:
    """Return a clause for each object: its best grasp, or why it was not found or not grasped."""
    # An open verdict keeps an object from being grasped, which then says the same again.
    repeated = {obj.message for obj in look.found.open} if considered else set()
    return (*considered, *(text for text in look.found.messages if text not in repeated))


def verdict_sentence(attempt: Pick, held: bool) -> str:
    """Return the result in a sentence."""
    if attempt.grasp is None:
        # Hundreds of refused grasps have too many reasons for a sentence.
        why = attempt.outcome
        if attempt.considered:
            why = "no object that was found has a safe grasp. The last table says why for each"
        return f"Nothing was grasped: {why}."
    object_name = attempt.target.model.name if attempt.target is not None else "object"
    state = "is in the hand" if held else "is not in the hand"
    sentence = (
        f"The {object_name} {state} after the lift; predicted probability "
        f"{attempt.grasp.success_probability:.0%}."
    )
    # What happened explains a failure, and would only lengthen a success.
    return sentence if held else f"{sentence} {_sentence(attempt.outcome)}"
