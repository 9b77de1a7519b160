import shutil

import numpy as np
import pytest
from jaxlie import SE3
from shared_data import shared_data

from smartview_jax.io import (
    import_correspondences,
    import_visp,
    read_visp_camera,
    read_visp_pose,
    write_visp_pose,
)
from smartview_jax.targets import Chessboard, TagGrid

NAMES = {"poses": "franka_pose_rPe_{view}.yaml", "pictures": "franka_image-{view}.png"}


@pytest.mark.parametrize(
    ("name", "target", "mount"),
    [
        ("visp_franka_eih", Chessboard(6, 9, 0.0236), "eye_in_hand"),
        ("visp_franka_eth", TagGrid(1, 1, 0.048, first_id=10), "eye_to_hand"),
    ],
)
def test_a_folder_of_visp_is_a_data_set(name, target, mount):
    folder = shared_data(name)
    data = import_visp(folder, target, mount, **NAMES)
    known = import_correspondences(folder / "poses.csv", folder / "corners.csv", (640, 480), mount)
    # ViSP counts from 1, the table from 0.
    assert data.view_ids == tuple(str(int(view) + 1) for view in known.view_ids)
    np.testing.assert_allclose(
        data.base_from_tool.as_matrix(), known.base_from_tool.as_matrix(), atol=1e-6
    )
    seen = np.asarray(data.visible)
    assert seen.all()
    gap = np.linalg.norm(np.asarray(data.pixels)[:, :, None] - known.pixels[:, None], axis=-1)
    # Another OpenCV finds a few corners elsewhere.
    assert np.sqrt(np.mean(gap.min(axis=2) ** 2)) < 0.05


def test_poses_are_written_as_they_are_read(tmp_path):
    pose = SE3.exp(np.array([0.3, -0.1, 0.7, -2.9, 0.4, 0.8]))
    write_visp_pose(tmp_path / "pose.yaml", pose)
    again = read_visp_pose(tmp_path / "pose.yaml")
    np.testing.assert_allclose(again.as_matrix(), pose.as_matrix(), atol=1e-14)


def test_cameras_of_visp_are_read():
    camera = read_visp_camera(shared_data("visp_franka_eih") / "franka_camera.xml")
    assert camera.image_size == (640, 480)
    assert float(camera.alpha_u) == pytest.approx(607.593, abs=1e-3)
    assert float(camera.v0) == pytest.approx(243.255, abs=1e-3)


def test_what_does_not_belong_together_is_named(tmp_path):
    target = Chessboard(6, 9, 0.0236)
    with pytest.raises(FileNotFoundError, match=r"pose_rPe_\{view\}\.yaml: no such files"):
        import_visp(tmp_path, target)
    write_visp_pose(tmp_path / "pose_rPe_1.yaml", SE3.identity())
    with pytest.raises(FileNotFoundError, match=r"image-1\.png: no such picture"):
        import_visp(tmp_path, target)
    original = shared_data("visp_franka_eih") / "franka_image-1.png"
    for number in (1, 2):
        shutil.copy(original, tmp_path / f"image-{number}.png")
    with pytest.raises(ValueError, match=r"no pose for the picture image-2\.png"):
        import_visp(tmp_path, target)


def test_wrong_files_are_named(tmp_path):
    (tmp_path / "pose.yaml").write_text("rows: 6\ndata: [1, 2]\n")
    with pytest.raises(ValueError, match=r"pose\.yaml: data: expected 6 numbers"):
        read_visp_pose(tmp_path / "pose.yaml")
    (tmp_path / "camera.xml").write_text("<root><camera><px>1</px></camera></root>")
    with pytest.raises(ValueError, match="entry 'image_width' is missing"):
        read_visp_camera(tmp_path / "camera.xml")
    (tmp_path / "bomb.xml").write_text('<!DOCTYPE r [<!ENTITY a "b">]><root/>')
    with pytest.raises(ValueError, match="entity declarations"):
        read_visp_camera(tmp_path / "bomb.xml")


def test_angles_in_degrees_are_named_with_their_file(tmp_path):
    path = tmp_path / "pose.yaml"
    path.write_text("rows: 6\ncols: 1\ndata: [[0.5], [0.1], [0.2], [17.0], [0.0], [0.0]]\n")
    with pytest.raises(ValueError, match=r"pose\.yaml: rotation_vector: angles up to 17 .*degrees"):
        read_visp_pose(path)
