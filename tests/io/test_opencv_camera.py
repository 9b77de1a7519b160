import cv2
import numpy as np
import pytest

from smartview_jax.io import read_opencv_camera


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


def test_wrong_files_are_named(tmp_path):
    (tmp_path / "evil.yaml").write_text("%YAML:1.0\n---\na: !!python/object/apply:os.getcwd []\n")
    with pytest.raises(ValueError, match="not readable as YAML"):
        read_opencv_camera(tmp_path / "evil.yaml")
    with pytest.raises(FileNotFoundError, match=r"none\.yaml"):
        read_opencv_camera(tmp_path / "none.yaml")
    (tmp_path / "half.yaml").write_text("%YAML:1.0\n---\nimage_width: 640\n")
    with pytest.raises(ValueError, match=r"half\.yaml: .*entry 'camera_matrix' is missing"):
        read_opencv_camera(tmp_path / "half.yaml")


MESSAGE = """header: {{stamp: {{sec: 1, nanosec: 2}}, frame_id: camera}}
height: 960
width: 1280
distortion_model: plumb_bob
{d}: [-0.1, 0.03, 0.001, 0.002, 0.0]
{k}: [{f}, 0.0, 640.0, 0.0, {f}, 480.0, 0.0, 0.0, 1.0]
binning_x: {binning}
binning_y: {binning}
roi: {{x_offset: {x}, y_offset: 0, height: 0, width: {width}, do_rectify: false}}
---
"""


@pytest.mark.parametrize(("k", "d"), [("k", "d"), ("K", "D")])
def test_a_printed_message_of_ros_is_the_camera_of_its_pictures(tmp_path, k, d):
    path = tmp_path / "info.yaml"
    path.write_text(MESSAGE.format(k=k, d=d, f=900.0, binning=0, x=0, width=0))
    whole = read_opencv_camera(path)
    assert whole.image_size == (1280, 960)
    path.write_text(MESSAGE.format(k=k, d=d, f=900.0, binning=2, x=300, width=640))
    part = read_opencv_camera(path)
    assert part.image_size == (320, 480)
    # A binned pixel is the mean of two by two, whose indices are 300 + 2 u + 0.5 and 2 v + 0.5.
    point, matrix = (
        np.array([[0.1, -0.05, 1.0]]),
        np.array([[900.0, 0, 640], [0, 900, 480], [0, 0, 1]]),
    )
    coefficients = np.array([-0.1, 0.03, 0.001, 0.002, 0.0])
    (u, v) = cv2.projectPoints(point, np.zeros(3), np.zeros(3), matrix, coefficients)[0].ravel()
    np.testing.assert_allclose(np.asarray(whole.project(point)[0])[0], [u, v], atol=1e-9)
    expected = [(u - 300.0 - 0.5) / 2.0, (v - 0.5) / 2.0]
    np.testing.assert_allclose(np.asarray(part.project(point)[0])[0], expected, atol=1e-9)


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_a_message_without_coefficients_is_of_a_lens_without_distortion(tmp_path, model):
    path = tmp_path / "info.yaml"
    text = MESSAGE.format(k="k", d="d", f=900.0, binning=0, x=0, width=0)
    text = text.replace("[-0.1, 0.03, 0.001, 0.002, 0.0]", "[]").replace("plumb_bob", model)
    path.write_text(text)
    camera = read_opencv_camera(path)
    point = np.array([[0.1, -0.05, 1.0]])
    expected = [640.0 + 90.0, 480.0 - 45.0]
    if model == "equidistant":
        distance = np.hypot(0.1, -0.05)
        expected = 900.0 * np.arctan(distance) / distance * point[0, :2] + [640.0, 480.0]
    np.testing.assert_allclose(np.asarray(camera.project(point)[0])[0], expected, atol=1e-9)


def test_a_message_of_a_camera_that_was_not_calibrated_is_told_so(tmp_path):
    path = tmp_path / "info.yaml"
    path.write_text(MESSAGE.format(k="k", d="d", f=0.0, binning=0, x=0, width=0))
    with pytest.raises(ValueError, match="was not calibrated"):
        read_opencv_camera(path)
