import cv2
import numpy as np
import pytest
from shared_data import shared_data

from smartview_jax.io import (
    read_matrix_rows,
    read_opencv_camera,
    read_visp_camera,
    read_visp_pose,
)


def known_poses(folder):
    return np.genfromtxt(folder / "poses.csv", delimiter=",", skip_header=1)[:, 1:].reshape(
        -1, 4, 4
    )


def test_matrices_on_lines():
    folder = shared_data("tampere_kuka_2")
    poses = read_matrix_rows(folder / "RobotPosesVec.txt", "m")
    np.testing.assert_allclose(poses.as_matrix(), known_poses(folder), atol=1e-6)


def test_visp_poses_and_camera():
    folder = shared_data("visp_franka_eih")
    for view, known in enumerate(known_poses(folder), start=1):
        pose = read_visp_pose(folder / f"franka_pose_rPe_{view}.yaml")
        np.testing.assert_allclose(pose.as_matrix(), known, atol=1e-6)
    camera = read_visp_camera(folder / "franka_camera.xml")
    assert camera.image_size == (640, 480)
    assert float(camera.alpha_u) == pytest.approx(607.593, abs=1e-3)
    assert float(camera.v0) == pytest.approx(243.255, abs=1e-3)


@pytest.mark.parametrize("count", [4, 5, 8])
def test_cameras_that_opencv_wrote(tmp_path, count):
    K = np.array([[800.0, 0, 320.5], [0, 790.0, 239.5], [0, 0, 1]])
    distortion = 0.01 * np.arange(1.0, count + 1.0)
    path = tmp_path / "camera.yaml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("camera_matrix", K)
    file.write("distortion_coefficients", distortion[None])
    file.release()
    camera = read_opencv_camera(path)
    assert camera.image_size == (640, 480)
    np.testing.assert_allclose(
        [float(x) for x in vars(camera.lens).values()], distortion, atol=1e-15
    )
    assert float(camera.alpha_v) == 790.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3\n", "line 1 has 3 numbers, not 16"),
        ("a b\n", "line 1 is not a row of numbers"),
        ("# nothing\n", "no poses"),
        (" ".join(map(str, np.diag([1, 1, -1, 1]).ravel())), "row 1: .*mirrored"),
    ],
)
def test_wrong_lines_are_named(tmp_path, text, message):
    (tmp_path / "poses.txt").write_text(text)
    with pytest.raises(ValueError, match=rf"poses\.txt: .*{message}"):
        read_matrix_rows(tmp_path / "poses.txt", "m")


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
    (tmp_path / "evil.yaml").write_text("%YAML:1.0\n---\na: !!python/object/apply:os.getcwd []\n")
    with pytest.raises(ValueError, match="not readable as OpenCV YAML"):
        read_opencv_camera(tmp_path / "evil.yaml")
    with pytest.raises(FileNotFoundError, match=r"none\.yaml"):
        read_opencv_camera(tmp_path / "none.yaml")
