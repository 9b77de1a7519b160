"""`smartview localize`: from pictures, poses and models to where objects are."""

import dataclasses
import json
import shutil

import cv2
import numpy as np
import pytest
from board_scene import run
from seen_scene import CALIBRATION, POSES, SAMPLES, base_from_tool, seen_scene
from text_files import unwrapped

from smartview_jax import localization
from smartview_jax.io import save_object_model, write_mesh, write_object_views
from smartview_jax.modeling import Face, ObjectModel
from smartview_jax.simulation import box


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The pictures of the seen scene, the model of its stepped block, and one of a slab."""
    path, scene = tmp_path_factory.mktemp("localize"), seen_scene()
    write_object_views(path / "views", ["left", "right"], scene.pictures, base_from_tool())
    block = dataclasses.replace(scene.models[0], name="block")
    save_object_model(block, path / "block.json")
    slab = box(0.05, 0.01, 0.01)
    faces = tuple(Face(tuple(one)) for one in slab.faces)
    save_object_model(
        ObjectModel(slab.vertices, slab.edges, faces, name="slab"), path / "slab.json"
    )
    write_mesh(ObjectModel(slab.vertices + 1.0, slab.edges, faces), path / "far.stl")
    CALIBRATION.save(path / "calibration.yaml")
    return path


def words(folder, *more, models=("block.json",)):
    return [
        "localize", folder / "calibration.yaml", folder / "views",
        *(folder / one for one in models), *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def search(folder, tmp_path_factory):
    """What a person reads of a search for the block, its page, and what the library found."""
    page, found = tmp_path_factory.mktemp("page") / "found.html", []
    localize = localization.localize

    def spied(*given, occluders, **more):
        # The slab of the file, a metre away.
        assert occluders.shape == (12, 3, 3)
        assert abs(occluders - 1.0).max() < 0.05
        found.append(localize(*given, occluders=occluders, **more))
        return found[0]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("smartview_jax.localize", spied)
        patch.setattr("smartview_jax.localization.judging.candidates.FIT_SAMPLES", SAMPLES)
        done = run(*words(folder, "--out", page, "--occluder", folder / "far.stl"))
    return done, page.read_text(), found[0]


def test_a_found_object_is_said_shown_and_can_be_grasped(folder, search):
    done, page, _ = search
    assert done.exit_code == 0, done.output
    said = done.stdout.splitlines()
    assert said[1].startswith("block   accepted  ")
    assert "Found for certain in 2 pictures: block." in said
    assert f"{folder / 'calibration.yaml'} has no covariance: taken as exact" in unwrapped(
        done.stdout
    )
    # The columns are two blanks apart; the third is the pose.
    text = said[1].split("  ")[2].strip()
    numbers = np.array([float(word) for word in text.split(",")])
    turn = np.degrees(np.arctan2(POSES[0][1, 0], POSES[0][0, 0]))
    np.testing.assert_allclose(numbers[:3], POSES[0][:3, 3], atol=3e-4)
    np.testing.assert_allclose(numbers[3:], [turn, 0.0, 0.0], atol=0.3)
    assert page.count("data:image/jpeg") == 2
    given = ["--object-pose", text, "--grasp-pose", "0,0,0.01,0,180,0"]
    grasp = run("grasp", folder / "calibration.yaml", *given, "--json")
    assert grasp.exit_code == 0, grasp.output


def test_a_program_reads_that_the_other_model_is_not_there(folder, search, monkeypatch):
    """As if both models had been searched for, and the block's pose refused for the slab."""
    (block,) = found = search[-1]

    def localize(_, command, __, models, **___):
        slab, _ = models
        verdict = block.verdict._replace(decision="rejected", reasons=("too few edges",))
        rejected = block._replace(model=slab, model_index=0, verdict=verdict)
        accepted = block._replace(model_index=1)
        messages = ("slab: too few edges",)
        return localization.Localizations((accepted, rejected), messages, found.pictures, command)

    monkeypatch.setattr("smartview_jax.localize", localize)
    done = run(*words(folder, "--json", models=("slab.json", "block.json")))
    assert done.exit_code == 0, done.output
    document = json.loads(done.stdout)
    assert document["views"] == ["left", "right"]
    by_name = {entry["name"]: entry for entry in document["objects"]}
    assert by_name["block"]["verdict"] == "accepted"
    assert by_name["block"]["model"] == str(folder / "block.json")
    np.testing.assert_allclose(by_name["block"]["covariance"], block.covariance)
    assert by_name["slab"]["verdict"] == "rejected"
    assert by_name["slab"]["model"] == str(folder / "slab.json")
    assert by_name["slab"]["reasons"] == ["too few edges"]
    assert document["messages"] == ["slab: too few edges"]


def test_what_is_not_in_the_box_is_not_found(folder, tmp_path):
    page = tmp_path / "found.html"
    done = run(*words(folder, "--workspace", "0.5,0.5,0,0.6,0.6,0.1", "--out", page))
    assert done.exit_code == 1, done.output
    assert "Nothing was found for certain." in done.stdout
    assert "block: not found" in done.stdout
    assert "block: not found" in page.read_text()


@pytest.mark.parametrize(
    ("more", "models", "said"),
    [
        (["--workspace", "0,0,0,1,1"], ("block.json",), "--workspace: expected 6 numbers"),
        (["--workspace", "0,0,0,1,1,nan"], ("block.json",), "--workspace: expected 6 numbers"),
        (["--occluder", "nowhere.stl"], ("block.json",), "nowhere.stl: no such file"),
        ([], ("nowhere.json",), "nowhere.json"),
        (["--out", "{folder}/block.json/found.html"], ("block.json",), "--out"),
    ],
)
def test_what_is_wrong_is_named_before_the_search(folder, more, models, said):
    given = [one.format(folder=folder) for one in more]
    done = run(*words(folder, *given, models=models))
    assert done.exit_code == 2
    assert said in done.stderr


def test_a_bad_picture_is_named(folder, tmp_path):
    shutil.copytree(folder / "views", tmp_path / "views")
    size = CALIBRATION.camera.image_size
    picture = tmp_path / "views" / "images" / "right.png"
    for shape, said in ((size[::-1], "right.png: "), ((48, 64), "right.png: ")):
        cv2.imwrite(str(picture), np.full(shape, 90, np.uint8))
        done = run("localize", folder / "calibration.yaml", tmp_path / "views",
                   folder / "block.json")  # fmt: skip
        assert done.exit_code == 2, done.output
        assert said in done.stderr
