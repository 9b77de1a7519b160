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
