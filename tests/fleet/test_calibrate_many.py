"""Each of many data sets gets its calibration, or an error with its name."""

import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from board_scene import board_folder
from fit_scenes import scene_of

from smartview_jax import calibrate, calibrate_many


def test_each_data_set_gets_its_calibration_or_an_error(tmp_path_factory):
    """Of any number of views, as a folder or a data set; a failure is the data set's own."""
    folder, scene = board_folder(tmp_path_factory), scene_of(0)
    given = [scene.data, folder, scene.data.select(range(1)), folder.parent / "nowhere"]
    said = []
    with ThreadPoolExecutor(1) as executor:
        many = calibrate_many(given, executor, progress=said.append, lens="radial")
        found = {outcome.number: outcome for outcome in many}
    assert [found[k].name for k in range(4)] == ["data set 0", folder.name, "data set 2", "nowhere"]
    alone = calibrate(scene.data, "radial")
    np.testing.assert_array_equal(found[0].fit.covariance, alone.covariance)
    assert found[1].fit.result.converged
    assert found[1].error is None
    assert "at least 3 views" in str(found[2].error)
    assert "nowhere: no such folder" in str(found[3])
    assert found[3].fit is None
    assert said[-1].endswith("4 of 4")
    # As processes send it.
    copy = pickle.loads(pickle.dumps(found[0].fit))
    assert str(copy) == str(found[0].fit)


def test_wrong_arguments_are_named_before_the_work():
    with pytest.raises(TypeError, match="'lenz' is no option"):
        calibrate_many([], lenz="radial")
    with pytest.raises(TypeError, match="xecutor"):
        calibrate_many([], "processes")
    with pytest.raises(ValueError, match="at least one process, found 0"):
        calibrate_many([], 0)
