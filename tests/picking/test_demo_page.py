"""The page of a run has the parts of Fig. 8, and its texts are sentences."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from fake_cell import CALIBRATION, CAMERA, REGION, STRIPED, localizations, seen, view_of
from solids import box

from smartview_jax.features import picture_evidence
from smartview_jax.geometry import host_matrices, host_transforms, look_at
from smartview_jax.picking import CellCalibration, Look, Pick
from smartview_jax.picking.story import (
    grasp_section,
    localised_section,
    numbers_section,
    verdict_sentence,
)
from smartview_jax.robots import Command

MODEL = box(name="box")
CALIBRATED = CellCalibration(SimpleNamespace(calibration=CALIBRATION, pixel_sigma=0.1), None, ())
REASONS = (
    "it separates the object from 1 remaining rival (expected odds 10 : 1); the position error",
    "the objects are certain already; it is the paper's view, along the normal",
)


def look_of(count, chosen, *results):
    """Views of the region from above."""
    directions = np.column_stack(
        [np.linspace(-0.3, 0.3, count), np.full(count, 0.2), -np.ones(count)]
    )
    poses = np.linalg.inv(host_matrices(look_at(REGION.centre, directions, 0.5)))
    evidence = picture_evidence(STRIPED, CAMERA)
    command = Command(host_transforms(poses))
    found = localizations(*results, pictures=(evidence,) * count, command=command)
    return Look(found, (STRIPED,) * count, command, chosen, ("view 3: why",))


def strip_of(*phases):
    return [(phase, np.zeros((48, 64), np.uint8)) for phase in phases]


@pytest.mark.parametrize("reason", REASONS)
def test_figure_8_has_its_parts_and_a_reason_in_a_sentence(reason):
    look = look_of(3, view_of(reason), seen(MODEL))
    section = localised_section(look, CALIBRATED, REGION, strip_of("before", "pre_grasp"))
    assert [figure.name for figure in section.figures] == [f"({letter})" for letter in "abcdef"]
    texts = [figure.text for figure in section.figures]
    assert texts[0] == "edges and features of view 1"
    assert texts[2] == "the verification view"
    assert texts[5] == "the bin, last seen: pre-grasp"
    # Cropped to the region; the wireframe alone in (d), and over the picture in (e).
    plain, alone, both = (section.figures[k].picture for k in (2, 3, 4))
    assert plain.shape[0] < STRIPED.shape[0]
    coloured = np.ptp(both, axis=2) > 0
    assert coloured.any()
    assert np.array_equal(np.ptp(alone, axis=2) > 0, coloured)
    assert np.mean(both[..., 0] == plain) > 0.9
    assert np.ptp(alone[~coloured]) == 0
    sentences = re.split(r"(?<=\.) ", section.text)
    assert sentences[-1] == f"Why it was chosen: {reason}."
    assert all(re.fullmatch(r"[A-Z].*[^.]\.", sentence) for sentence in sentences)


def test_two_views_that_were_enough_have_no_reason():
    section = localised_section(look_of(2, None, seen(MODEL)), CALIBRATED, REGION, strip_of("lift"))
    assert [figure.name for figure in section.figures] == [f"({letter})" for letter in "abcdef"]
    assert section.figures[2].text == "the last view"
    assert section.text == "Two views are searched for the models."


def test_an_outcome_is_a_sentence_with_its_names():
    attempt = Pick(None, None, None, None, float("nan"), "no safe grasp of Box A: no faces")
    assert grasp_section(attempt, strip_of("before")).text == "No safe grasp of Box A: no faces."


def test_numbers_without_a_look_tell_the_outcome():
    attempt = Pick(None, None, None, None, float("nan"), "not found: view 1: picture: blank")
    rows = numbers_section(attempt, CALIBRATED, MODEL, float("nan"), False, []).rows
    assert ("views of the bin", "0") in rows
    assert rows[-1] == ("outcome", "not found: view 1: picture: blank")


def test_every_object_says_once_what_became_of_it():
    look = look_of(
        3, view_of(), seen(MODEL, "open", "ambiguous"), seen(box(name="nut"), "rejected", "hidden")
    )
    attempt = Pick(look, None, None, None, float("nan"), "nothing")
    rows = numbers_section(attempt, CALIBRATED, MODEL, 0.0, False, []).rows
    assert ("views of the bin", "3") in rows
    assert rows[-3:] == [
        ("views", "view 3: why"),
        ("object", "box: open: ambiguous"),
        ("object", "nut: not found: hidden"),
    ]
    attempt = attempt._replace(considered=("box is not grasped: open: ambiguous",))
    rows = numbers_section(attempt, CALIBRATED, MODEL, 0.0, False, []).rows
    assert rows[-2:] == [
        ("object", "box is not grasped: open: ambiguous"),
        ("object", "nut: not found: hidden"),
    ]


def test_the_verdict_says_what_happened_unless_the_object_is_in_the_hand():
    grasp, target = SimpleNamespace(success_probability=0.97), SimpleNamespace(model=MODEL)
    attempt = Pick(None, target, None, grasp, 0.0, "the fingers closed to 0.0 mm")
    sentence = "The box is {} the hand after the lift; predicted probability 97%."
    assert verdict_sentence(attempt, True) == sentence.format("in")
    failed = f"{sentence.format('not in')} The fingers closed to 0.0 mm."
    assert verdict_sentence(attempt, False) == failed
    nothing = attempt._replace(grasp=None, outcome="not found: view 1: blank")
    assert verdict_sentence(nothing, False) == "Nothing was grasped: not found: view 1: blank."
    refused = nothing._replace(considered=("no safe grasp of box: the palm touches table",))
    assert verdict_sentence(refused, False) == (
        "Nothing was grasped: no object that was found has a safe grasp. "
        "The last table says why for each."
    )
