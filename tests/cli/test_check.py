"""What `smartview check` says of data that can be calibrated; `test_every_verb` has the others."""

from board_scene import board_folder, run


def test_good_data_can_begin(tmp_path_factory):
    ended = run("check", board_folder(tmp_path_factory))
    assert ended.exit_code == 0, ended.output
    assert "board: 8 views, eye_in_hand" in ended.output
    assert "usable views: 8; take more" in ended.output
    assert "camera and robot agree" in ended.output
