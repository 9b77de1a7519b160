"""Odd names are read back equal from every file, or refused before anything is written.

Every function of the package that writes a file is in `WRITERS`, with the pair of a writer and a
reader that tests it, or with the reason why no name that a user gives is in its file.
"""

import ast
import json
import shutil

import numpy as np
import pytest
from test_layers import FILES, PACKAGE, tree_of

import smartview_jax as sv
from smartview_jax.dataset import DepthNoise, PoseDataset
from smartview_jax.detection import Detection
from smartview_jax.editor.document import Document, apply_change
from smartview_jax.editor.edit_history import EditHistory
from smartview_jax.files import dump_yaml, read_yaml, write_atomically
from smartview_jax.geometry import host_transforms
from smartview_jax.io import (
    import_correspondences,
    load_object_model,
    load_object_views,
    load_pose_log,
    read_misses,
    read_viewpoints,
    ros_camera_info,
    save_object_model,
    write_dataset_folder,
    write_object_views,
    write_pose_log,
    write_viewpoints,
)
from smartview_jax.io.csv_tables import write_table
from smartview_jax.io.detections import KeptDetection, read_kept_detections, write_kept_detections
from smartview_jax.io.growing_dataset import GrowingDataset
from smartview_jax.io.new_dataset import write_description
from smartview_jax.io.poses import read_poses
from smartview_jax.modeling import Face, Grasp, ObjectModel
from smartview_jax.robots import kuka_lwr4
from smartview_jax.simulation import paper_calibration
from smartview_jax.targets import CircleGrid

REFUSED = [
    "",
    " ",
    "a\tb",
    "a\nb",
    "a\r\nb",
    "a\xa0b",
    "a\u2028b",
    "a\u200fb",
    "a\0b",
    "\ud800",
    " a",
    "a ",
    "x" * 201,
    "\U0001f600" * 100,
    "#c",
    "../../y",
    "a\\..\\b",
    "a/../../../b",
    "/tmp/y",
    "\\\\host\\y",
    "C:y",
    "a//b",
    "a/./b",
    "a/",
]
KEPT = [
    *"a,b a;b null Null ~ 1e3 1_000 .5 0x1f 1:30 yes no on 001 -1 nan inf x.png x.jpg.png".split(),
    *"CON true 2001-01-01 = << {view} {0} [red] [/b] * ? %s $HOME & | > ` @ ! <!--<script>".split(),
    *'v1.0 ... a/b a\\b view é 日本 it\'s a\'b " \'\' "" "q" a"b { [ =1+1'.split(),
    *("a, b", "a b", "- a", "ab: c", "a #b", "\U0001f600", "x" * 200),
]

TARGET = CircleGrid(3, 4, 0.01)
ARM = kuka_lwr4()
JOINTS = np.random.default_rng(0).uniform(-1.0, 1.0, (len(KEPT), 7))
PIXELS = 100.0 + 3000.0 * TARGET.points[:, :2] + 4.0 * np.arange(len(KEPT))[:, None, None]
POSES = np.asarray(ARM.base_from_tool(JOINTS).as_matrix())
MATRIX = [f"m{i}{j}" for i in range(4) for j in range(4)]
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) * 0.1


def data(names):
    """A data set of views with names that its own check did not see."""
    count = len(names)
    plain = sv.Dataset.from_arrays(
        TARGET.points,
        PIXELS[:count],
        POSES[:count],
        (640, 480),
        target=TARGET,
        joints=JOINTS[:count],
        arm=ARM,
    )
    object.__setattr__(plain, "view_ids", names)
    return plain


def model(name, part):
    """A model of one face and grasp, with a part whose name its own check did not see."""
    grasp = Grasp("a grasp", 0, np.eye(4), 0.05, 0.0, 0.01)
    made = ObjectModel(CORNERS, faces=(Face((0, 1, 2, 3)),), grasps=(grasp,))
    parts = {"object": made, "face": made.faces[0], "grasp": grasp}
    object.__setattr__(parts[part], "name", name)
    return made


def dataset_folder(folder, names):
    sv.save_dataset(data(names), folder)
    return sv.load_dataset(folder).view_ids


def depths(folder, names):
    given = data(names)
    at_points = np.where(np.asarray(given.visible), 0.4, np.nan)
    sv.save_dataset(given.with_depths(at_points, DepthNoise(1e-3, 0.0)), folder)
    again = sv.load_dataset(folder)
    assert again.depths.used.any(axis=1).all()
    return again.view_ids


def tracked_covariances(folder, names):
    seen = POSES[: len(names)]
    covariance = np.tile(1e-6 * np.eye(6), (len(seen), 1, 1))
    poses = PoseDataset.from_poses(seen, seen).with_covariance(covariance)
    object.__setattr__(poses, "view_ids", names)
    sv.save_dataset(poses, folder)
    again = sv.load_dataset(folder)
    np.testing.assert_allclose(again.covariance, covariance)
    return again.view_ids


def description(folder, names):
    pictures = {"pictures": {"pattern": "images/{view}.png"}}
    poses = host_transforms(POSES[: len(names)])
    write_dataset_folder(folder, names, poses, (640, 480), TARGET, "eye_in_hand", pictures)
    entry = read_yaml(folder / "dataset.yaml")["poses"]
    return read_poses(folder, entry, "raise").view_ids


def kept_detections(folder, names):
    path, visible = folder / "detections.csv", np.ones(len(TARGET.points), bool)
    actual = KeptDetection("a1", Detection(PIXELS[0], visible, None))
    nothing = KeptDetection("b2", Detection(np.full_like(PIXELS[0], np.nan), ~visible, "dark"))
    for detection in (actual, nothing):
        write_kept_detections(path, dict.fromkeys(names, detection))
        views = tuple(read_kept_detections(path, names, len(TARGET.points)))
        if views != names:
            return views
    return names


def object_views(folder, names):
    pictures = [np.full((12, 16), k, np.uint8) for k in range(len(names))]
    write_object_views(folder, names, pictures, ARM.command(JOINTS[: len(names)]), arm=ARM)
    return load_object_views(folder).view_ids


def viewpoints(suffix):
    def written_and_read(folder, names):
        path, count = folder / f"views{suffix}", len(names)
        write_viewpoints(path, host_transforms(POSES[:count]), names, JOINTS[:count])
        return read_viewpoints(path).names

    return written_and_read


def one_by_one(written_and_read):
    """The same for several names, of which each has a file."""

    def each(folder, names):
        return tuple(written_and_read(folder, name) for name in names)

    return each


@one_by_one
def val_program(folder, name):
    """VAL has names of its own; nothing but such a name gets into a program."""
    path = folder / "views.val"
    write_viewpoints(path, host_transforms(POSES[:2]), [name, "other"])
    return path.read_text().splitlines()[0].split()[1]


def object_model(part):
    @one_by_one
    def written_and_read(folder, name):
        save_object_model(model(name, part), folder / "model.json")
        read = load_object_model(folder / "model.json")
        return {"object": read, "face": read.faces[0], "grasp": read.grasps[0]}[part].name

    return written_and_read


def calibration(suffix):
    @one_by_one
    def written_and_read(folder, name):
        path = folder / f"calibration{suffix}"
        paper_calibration().save(path, run=name, source="\u2028\x85 1e3")
        sv.Calibration.load(path)
        return read_yaml(path)["run"]

    return written_and_read


@one_by_one
def camera_info(folder, name):
    path = folder / "camera.yaml"
    write_atomically(path, ros_camera_info(paper_calibration(), name))
    return read_yaml(path)["camera_name"]


def misses(folder, names):
    path = folder / "misses.csv"
    write_table(path, ("view", "x_mm", "y_mm"), [(name, 0.5, 0.25) for name in names])
    read_misses(path, names)
    return names


def correspondences(folder, names):
    poses = zip(names, POSES, strict=False)
    rows = [[view, *map(float, pose.ravel())] for view, pose in poses]
    write_table(folder / "poses.csv", ("view", *MATRIX), rows)
    corners = [
        (view, *map(float, point), *map(float, pixel))
        for view, pixels in zip(names, PIXELS, strict=False)
        for point, pixel in zip(TARGET.points, pixels, strict=True)
    ]
    write_table(folder / "corners.csv", ("view", "X", "Y", "Z", "u", "v"), corners)
    read = import_correspondences(folder / "poses.csv", folder / "corners.csv", (640, 480))
    return read.view_ids


def picture_times(folder, names):
    logged, times = host_transforms(np.repeat(POSES[:1], 10, axis=0)), 0.1 * np.arange(10.0)
    entry = write_pose_log(folder, times, logged, names, np.linspace(0.1, 0.8, len(names)))
    target = {"kind": "chessboard", "rows": 9, "columns": 6, "square": 0.01}
    entries = {"camera": {"image_size": [640, 480]}, "target": target, "poses": entry}
    write_atomically(folder / "dataset.yaml", dump_yaml({"smartview_dataset": 1, **entries}))
    return load_pose_log(folder).view_ids


@one_by_one
def journal(folder, name):
    change = {"do": "rename", "name": name}
    changed = apply_change(Document(), change)
    history = EditHistory(folder / "model.json", {"views": ["v1"]})
    history.change(change, changed)
    history.close()
    history = EditHistory(folder / "model.json", {"views": ["v1"]})
    history.close()
    return history.document.name


def growing(folder, names):
    write_description(folder, TARGET, "eye_in_hand", (640, 480))
    before = files_in(folder)
    try:
        with GrowingDataset(folder) as views:
            for name, pose in zip(names, POSES, strict=False):
                views.add(np.zeros((480, 640), np.uint8), host_transforms(pose), name)
    except ValueError:
        assert files_in(folder) == before
        shutil.rmtree(folder)
        raise
    with GrowingDataset(folder) as views:
        return views.names


PAIRS = {
    "data set": dataset_folder,
    "depths": depths,
    "covariances of tracked poses": tracked_covariances,
    "description": description,
    "kept detections": kept_detections,
    "object views": object_views,
    "viewpoints in CSV": viewpoints(".csv"),
    "viewpoints in JSON": viewpoints(".json"),
    "VAL": val_program,
    "object": object_model("object"),
    "face": object_model("face"),
    "grasp": object_model("grasp"),
    "calibration in YAML": calibration(".yaml"),
    "calibration in JSON": calibration(".json"),
    "camera_info": camera_info,
    "misses": misses,
    "correspondences": correspondences,
    "times of pictures": picture_times,
    "growing data set": growing,
    "journal": journal,
}

MAY_BE_EMPTY = {"object", "face", "grasp", "journal"}
"""A face may have no name; the editor's document is one of an object."""

WRITERS = {
    "calibration/calibration.py save": "calibration in YAML",
    "io/csv_tables.py write_table": "misses",
    "io/csv_tables.py write_view_table": "data set",
    "cli/calibrate_poses.py write_files": "(the package's own)",
    "io/dataset_folder.py write_described_folder": "description",
    "io/detections.py write_detections": "data set",
    "io/detections.py write_kept_detections": "kept detections",
    "io/easy_handeye.py write_easy_handeye": "(poses only)",
    "io/growing_dataset.py add": "growing data set",
    "io/new_dataset.py write_description": "(a table without rows)",
    "io/matrix_rows.py write_matrix_rows": "(poses only)",
    "io/meshes.py write_mesh": "(triangles only)",
    "io/new_dataset.py write_new_dataset": "(a table without rows)",
    "io/object_models.py save_object_model": "object",
    "joint/relative_pose.py save": "(a pose only)",
    "joint/rig_estimate.py save_rig": "(names of cameras, which Rig limits)",
    "io/object_views.py write_object_views": "object views",
    "io/pose_log.py write_pose_log": "times of pictures",
    "io/point_depths.py write_depths": "depths",
    "io/viewpoints.py write_viewpoints": "viewpoints in JSON",
    "io/visp.py write_visp_pose": "(one pose)",
    "recordings/import_bag.py _write_cameras": "(views are numbered)",
    "recordings/imported_folder.py write_record": "(views are numbered)",
    "recordings/picture_messages.py write": "(views are numbered)",
    "recordings/imported_folder.py write_description": "(views are numbered)",
    "picking/demo.py run_demo": "(the package's own)",
    "runtime/program_store/store.py _write_program": "(programs)",
    "runtime/program_store/store.py _write_trace": "(programs)",
    "report/page.py write_page": "(a page is not read back)",
    "report/story.py write_story": "(a page is not read back)",
    "schemas/validation.py write_validated": "description",
    "simulation/object_example.py write_object_example": "(the package's own)",
    "simulation/render.py write_pictures": "(the package's own)",
}
"""Every function that writes a whole file, with the pair that tests it, or why it has no name."""

WRITING = {"write_atomically", "write_validated", "write_table", "write_text", "write_bytes"}


def writers():
    """The functions of the package that write files, by file and name."""
    for file in (file for file in FILES if "write_" in file.read_text(encoding="utf-8")):
        for node in (n for n in ast.walk(tree_of(file)) if isinstance(n, ast.FunctionDef)):
            calls = (call.func for call in ast.walk(node) if isinstance(call, ast.Call))
            names = {getattr(func, "id", getattr(func, "attr", None)) for func in calls}
            if names & WRITING and node.name not in WRITING - {"write_table", "write_validated"}:
                yield f"{file.relative_to(PACKAGE).as_posix()} {node.name}"


def files_in(folder):
    return {path for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder so deep that a name that leads out of it still leads to what the test looks at."""
    folder = tmp_path / "one" / "two" / "three"
    folder.mkdir(parents=True)
    monkeypatch.chdir(folder)
    return folder


@pytest.mark.parametrize("pair", PAIRS)
def test_names_are_read_back_or_refused_and_nothing_is_written(place, tmp_path, pair):
    """A name that is refused among others that are good; all that are kept in one data set."""
    wrong = []
    groups = [(name, "other", "third") for name in REFUSED if name or pair not in MAY_BE_EMPTY]
    # VAL refuses nearly all of these, each under its name.
    groups += [(name,) for name in KEPT] if pair == "VAL" else [tuple(KEPT)]
    for number, names in enumerate(groups):
        folder, name = place / str(number), names[0]
        may_be_kept = name in KEPT
        try:
            read = tuple(PAIRS[pair](folder, names))
        except ValueError as error:
            named = repr(name[:60])[1:-1] in str(error) or name in str(error)
            if files_in(tmp_path) or not named:
                wrong.append((name, f"refused after writing, or not named: {error}"))
            if may_be_kept and pair != "VAL":
                wrong.append((name, f"one of the names is refused: {error}"))
            continue
        changed = [(a, b) for a, b in zip(names, read, strict=True) if a != b]
        wrong += [(name, f"read as {found!r}") for name, found in changed]
        if not may_be_kept:
            wrong.append((name, "accepted"))
        outside = [path for path in files_in(tmp_path) if folder not in path.parents]
        if outside:
            wrong.append((name, f"written outside of the folder: {outside}"))
        shutil.rmtree(folder)
    assert not wrong, "\n".join(f"{name!r}: {problem}" for name, problem in wrong[:5])


def test_every_writer_is_tested_or_has_no_names():
    actual = set(writers())
    assert actual == set(WRITERS), (actual - set(WRITERS), set(WRITERS) - actual)
    assert {pair for pair in WRITERS.values() if not pair.startswith("(")} <= set(PAIRS)


def test_names_of_earlier_versions_are_read_as_the_nearest(tmp_path):
    """An object's file and an editor's journal took any printable text."""
    path = tmp_path / "model.json"
    save_object_model(model("a face", "face"), path)
    for old, new in ((" top ", "top"), ("#1", "1"), ("", ""), ("../x", "x"), ("..", "")):
        text = path.read_text().replace('"name": "a face"', f'"name": {json.dumps(old)}')
        (tmp_path / "old.json").write_text(text)
        assert load_object_model(tmp_path / "old.json").faces[0].name == new
    change = {"do": "several", "changes": [{"do": "rename", "name": " #1 "}]}
    entries = [{"smartview_journal": 1, "views": ["v1"]}, change]
    lines = "".join(json.dumps(entry) + "\n" for entry in entries)
    (tmp_path / "drawn.json.journal").write_text(lines)
    history = EditHistory(tmp_path / "drawn.json", {"views": ["v1"]})
    history.close()
    assert history.document.name == "1"
