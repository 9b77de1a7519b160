"""Define the schemas of `object_views.yaml`, which describes pictures of an object."""

from typing import Annotated, Literal

from pydantic import Field, TypeAdapter, model_validator

from .dataset import CameraSizeEntry, JointsEntry, PicturesEntry, PosesEntry
from .entry import Entry, Expected, PrintableText
from .rig import CameraName, RigPicturesEntry


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


class RigObjectViewsFile(Entry):
    """A folder of pictures of an object by several cameras.

    Poses are by the robot's states; without a robot, `views` names the states.
    """

    smartview_object_views: Literal[1]
    cameras: Annotated[dict[CameraName, CameraSizeEntry], Field(min_length=1)]
    poses: PosesEntry | None = None
    joints: JointsEntry | None = None
    views: (
        Annotated[list[PrintableText], Field(min_length=1), Expected("names of views")] | None
    ) = None
    pictures: RigPicturesEntry
    end: Literal["smartview_object_views"]

    @model_validator(mode="after")
    def _check_consistency(self) -> "RigObjectViewsFile":
        has_robot = self.poses is not None or self.joints is not None
        if has_robot == (self.views is not None):
            raise ValueError(
                "expected an entry 'poses', 'joints', or both; or 'views' for cameras next to the "
                "arm, whose pictures do not depend on the robot"
            )
        return self


RIG_OBJECT_VIEWS_SCHEMA = TypeAdapter(RigObjectViewsFile)
