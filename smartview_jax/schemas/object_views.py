"""Define the schema of `object_views.yaml`, which describes pictures of an object."""

from typing import Literal

from pydantic import TypeAdapter, model_validator

from .dataset import CameraSizeEntry, JointsEntry, PicturesEntry, PosesEntry
from .entry import Entry


class ObjectViewsFile(Entry):
    """A folder of pictures of an object; the last entry shows that the file is complete."""

    smartview_object_views: Literal[1]
    camera: CameraSizeEntry
    poses: PosesEntry | None = None
    joints: JointsEntry | None = None
    pictures: PicturesEntry
    end: Literal["smartview_object_views"]

    @model_validator(mode="after")
    def _check_consistency(self) -> "ObjectViewsFile":
        if self.poses is None and self.joints is None:
            raise ValueError("expected an entry 'poses', 'joints', or both")
        return self


OBJECT_VIEWS_SCHEMA = TypeAdapter(ObjectViewsFile)
