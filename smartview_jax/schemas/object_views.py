"""Define the schema of `object_views.yaml`, which describes pictures of an object."""

from typing import Literal

from pydantic import TypeAdapter

from .dataset import CameraSizeEntry, PicturesEntry, PosesEntry
from .entry import Entry


class ObjectViewsFile(Entry):
    """A folder of pictures of an object; the last entry shows that the file is complete."""

    smartview_object_views: Literal[1]
    camera: CameraSizeEntry
    poses: PosesEntry
    pictures: PicturesEntry
    end: Literal["smartview_object_views"]


OBJECT_VIEWS_SCHEMA = TypeAdapter(ObjectViewsFile)
