"""Begin a data-set folder for a target that is known as an object, not as a text to fill in."""

from pathlib import Path

from ..geometry import pose_codec
from ..targets import AbstractTarget, target_to_dict
from .csv_tables import write_table
from .folder_description import DESCRIPTION_FILE, FORMAT_VERSION
from .poses import POSES_FILE, poses_entry
from .table_text import VIEW_COLUMN


def write_description(
    folder: Path,
    target: AbstractTarget,
    mount: str,
    image_size: tuple[int, int],
    pose_format: str = "matrix",
    suffix: str = ".png",
) -> None:
    """Write `dataset.yaml` and a table of poses without rows, to be filled by `GrowingDataset`.

    Args:
        folder: folder to create.
        target: the calibration target.
        mount: `"eye_in_hand"` or `"eye_to_hand"`.
        image_size: width and height of the pictures, px.
        pose_format: one of `POSE_CODECS`.
        suffix: of the pictures' names, with its full stop.

    Raises:
        ValueError: an unknown format or mount, or a target that could not be read back.
        FileExistsError: the folder has a description or a table already.
    """
    from ..schemas.dataset import DATASET_SCHEMA
    from ..schemas.validation import refuse_unreadable, write_validated

    codec = pose_codec(pose_format)
    description, table = folder / DESCRIPTION_FILE, folder / POSES_FILE
    for path in (description, table):
        if path.exists():
            raise FileExistsError(f"{path}: exists already; nothing is overwritten")
    content = {
        "smartview_dataset": FORMAT_VERSION,
        "camera": {"image_size": [int(size) for size in image_size]},
        "target": target_to_dict(target),
        "mount": mount,
        "poses": poses_entry(None, pose_format),
        "pictures": {"pattern": f"images/{{view}}{suffix}"},
    }
    refuse_unreadable(content, DATASET_SCHEMA, description)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    write_table(table, (VIEW_COLUMN, *codec.columns), [])
    # Written last, so that an interrupted run can be repeated.
    write_validated(description, content, DATASET_SCHEMA)
