"""Define `smartview new`, which begins a data-set folder for a robot and a target."""

from pathlib import Path
from typing import Annotated

import typer

import smartview_jax as sv

from .options import DebugOption
from .terminal import errors_reported, print_lines, print_steps

DEFAULT_SIZE = (1280, 1024)
"""Width and height in a new description, px; to be replaced by the real ones."""


def new(
    folder: Annotated[Path, typer.Argument(help="Folder of the new data set.")],
    robot: Annotated[
        str,
        typer.Option(
            help="The robot's pose format (such as ur): abb, fanuc, kawasaki, kuka, puma, ros, ur, "
            "or matrix."
        ),
    ] = "matrix",
    target: Annotated[
        str,
        typer.Option(
            help="The target (such as chessboard): chessboard, circle_grid, charuco, tag_grid, or "
            "Kalibr's aprilgrid."
        ),
    ] = "charuco",
    eye_to_hand: Annotated[
        bool, typer.Option("--eye-to-hand", help="Fixed camera; the target is on the tool.")
    ] = False,
    cameras: Annotated[
        str | None,
        typer.Option(
            help="Names of several cameras that watch one robot, such as left,right,wrist; by "
            "default there is one."
        ),
    ] = None,
    arms: Annotated[
        str | None,
        typer.Option(
            help="With --cameras: the arm that carries each of them, in their order, such as "
            "a,a,b; a+b for a camera on the hand of a that sees a target on the hand of b. By "
            "default there is one."
        ),
    ] = None,
    debug: DebugOption = False,
) -> None:
    """Begin a data set: a commented dataset.yaml and an empty poses.csv, to be filled in.

    The next steps are printed; `smartview check` then checks what was filled in.
    """
    with errors_reported(debug):
        mount = "eye_to_hand" if eye_to_hand else "eye_in_hand"
        names = [] if cameras is None else _camera_names(cameras)
        arm_of = None if arms is None else _arm_names(arms, names)
        images = folder / "images"
        places = {name: images / name for name in names} or {"": images}
        pictures = {name: sv.io.found_pictures(place) for name, place in places.items()}
        sizes = {
            name: content.image_size if content else DEFAULT_SIZE
            for name, content in pictures.items()
        }
        suffixes = {content.suffix for content in pictures.values() if content}
        if len(suffixes) > 1:
            raise ValueError(
                f"{images}: expected pictures with one suffix for all cameras, found "
                f"{', '.join(sorted(suffixes))}"
            )
        suffix = suffixes.pop() if suffixes else ".png"
        path = sv.io.write_new_dataset(
            folder, robot, target, mount, sizes if names else sizes[""], suffix, arm_of
        )
        for name, content in pictures.items():
            if content:
                _print_pictures(places[name], content)
        typer.echo(f"{path}: written; next steps:")
        complete = all(pictures.values())
        each = f"{images}, a folder for each camera" if names else str(images)
        steps = [
            *([] if complete else [f"write the pictures' size and suffix into {path}"]),
            f"measure the target and write its size into {path}: a 1 % error there makes a 1 % "
            "error in every distance",
            f"take 15 pictures or more into {each}, with the target filling half of each, "
            "tilted by up to 40 degrees to all sides and turned about the optical axis",
            _step_of_poses(folder, bool(names), arm_of),
            f"smartview check {folder}",
            f"smartview calibrate {folder}",
        ]
        print_steps(steps)


def _step_of_poses(folder: Path, several: bool, arm_of: dict[str, str] | None) -> str:
    """Return where the poses of the robot, or of each arm, are to be written."""
    tables = " and ".join(str(folder / table) for table in sv.io.new_pose_tables(arm_of).values())
    what = "the robot's pose for each picture" if arm_of is None else "each arm's poses"
    each = ": one row for all cameras' pictures of the same name" if several else ""
    return f"write {what} into {tables}{each}"


def _print_pictures(folder: Path, content: "sv.io.FoundPictures") -> None:
    """Print what kind of pictures a folder has already."""
    width, height = content.image_size
    print_lines(
        f"{folder}: {content.picture_count} pictures named *{content.suffix}, {width} x {height} px"
    )
    if content.others:
        print_lines(f"{folder}: other files: {', '.join(content.others[:5])}")


def _camera_names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",")]
    if "" in names or len(set(names)) < len(names):
        raise ValueError(
            f"--cameras: expected different names between commas, such as left,right; "
            f"found {text!r}"
        )
    return names


def _arm_names(text: str, cameras: list[str]) -> dict[str, str]:
    names = [name.strip() for name in text.split(",")]
    parts = [arm for name in names for arm in sv.dataset.arms_of(name)]
    if len(names) != len(cameras) or "" in parts or set(parts) & set(cameras):
        raise ValueError(
            f"--arms: expected an arm for each camera of --cameras, such as a,a,b for three, with "
            f"names that no camera has; found {text!r} for {','.join(cameras) or 'no --cameras'}"
        )
    return dict(zip(cameras, names, strict=True))
