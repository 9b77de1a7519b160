"""Each of many data sets gets its calibration, or an error with its name."""

import inspect
import pickle
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from board_scene import board_folder
from fit_scenes import scene_of
from tracked_scene import data_of

from smartview_jax import calibrate, calibrate_many, save_dataset


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


def test_tracked_poses_are_fitted_and_what_is_no_data_set_loses_itself_only(tmp_path):
    """As a data set or its folder; two pairs are too few for the fit of poses."""
    folder = tmp_path / "tracked"
    save_dataset(data_of(0, views=2), folder)
    given = [data_of(0, views=2), folder, 3]
    with ThreadPoolExecutor(1) as executor:
        unchecked = inspect.unwrap(calibrate_many)
        *tracked, nothing = (str(outcome) for outcome in unchecked(given, executor))
        (wrong,) = calibrate_many(given[:1], executor, lens="radial")
    assert tracked == [
        f"{name}: samples: expected at least 3 pairs of poses, found 2"
        for name in ("data set 0", "tracked")
    ]
    assert nothing.startswith("data set 2: ")
    assert str(wrong.error) == "'lens' is no option of fit_poses, which takes tracked poses"


def test_wrong_arguments_are_named_before_the_work(tmp_path):
    for single in (tmp_path, str(tmp_path), scene_of(0).data, data_of(0)):
        with pytest.raises(TypeError, match="expected a list of data sets or folders, found a sin"):
            inspect.unwrap(calibrate_many)(single)
    with pytest.raises(TypeError, match="'lenz' is no option"):
        calibrate_many([], lenz="radial")
    with pytest.raises(TypeError, match="xecutor"):
        calibrate_many([], "processes")
    with pytest.raises(ValueError, match="at least one process, found 0"):
        calibrate_many([], 0)
