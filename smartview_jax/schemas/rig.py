"""Define the schema of a `dataset.yaml` with several cameras, which watched one robot."""

from typing import Annotated, Literal

from pydantic import AfterValidator, Field, TypeAdapter, model_validator

from .calibration import ImageSize
from .dataset import (
    END_MARK,
    DetectionsEntry,
    JointsEntry,
    PosesEntry,
    RoughPose,
    check_pattern,
    check_point_count,
)
from .entry import Entry, Expected, PrintableText
from .target import TargetEntry

_Mount = Literal["eye_in_hand", "eye_to_hand"]
_Name = Annotated[
    str,
    Field(pattern=r"^[A-Za-z0-9_-]{1,100}$"),
    Expected("a name of letters, digits, '_' and '-'"),
]


class RigPicturesEntry(Entry):
    """The file names of all cameras' pictures, as one pattern."""

    pattern: Annotated[
        str,
        Field(max_length=200),
        AfterValidator(lambda text: check_pattern(text, ("camera", "view"))),
        Expected(
            "a name with {camera} and {view}, and {height} if there are several heights, and no "
            "other braces"
        ),
    ]


class RigCameraEntry(Entry):
    """The size of a camera's pictures, its mount, and the name of the target that it sees."""

    image_size: ImageSize
    mount: _Mount | None = None
    target: PrintableText | None = None
    detections: DetectionsEntry | None = None


class RigFile(Entry):
    """The description of a folder with several cameras.

    All cameras see the one `target`, or each its own of the `targets`. A camera without a mount
    has the folder's.
    """

    smartview_dataset: Literal[1]
    end_mark: Literal[True] | None = None
    cameras: Annotated[dict[_Name, RigCameraEntry], Field(min_length=1)]
    target: TargetEntry | None = None
    targets: Annotated[dict[_Name, TargetEntry], Field(min_length=1)] | None = None
    mount: _Mount = "eye_in_hand"
    poses: PosesEntry | None = None
    joints: JointsEntry | None = None
    pictures: RigPicturesEntry | None = None
    base_from_world: RoughPose | None = None
    tool_from_world: RoughPose | None = None
    end: Literal["smartview_dataset"] | None = None

    @model_validator(mode="after")
    def _check_consistency(self) -> "RigFile":
        if self.end_mark and self.end != END_MARK:
            raise ValueError(f"the last line, 'end: {END_MARK}', is missing: the file was cut")
        if self.poses is None and self.joints is None:
            raise ValueError("expected an entry 'poses', 'joints', or both")
        self._check_targets()
        mounts = {camera.mount or self.mount for camera in self.cameras.values()}
        for name, mount in (
            ("base_from_world", "eye_in_hand"),
            ("tool_from_world", "eye_to_hand"),
        ):
            if getattr(self, name) is not None and mount not in mounts:
                raise ValueError(f"{name}: no camera is {mount}")
        return self

    def _check_targets(self) -> None:
        """Raise a ValueError unless every camera has one target that the file describes."""
        if (self.target is None) == (self.targets is None):
            raise ValueError(
                "expected either one 'target' for all cameras, or several 'targets' by name"
            )
        known = self.targets or {}
        for name, camera in self.cameras.items():
            if self.targets is None and camera.target is not None:
                raise ValueError(f"cameras.{name}.target: there is one 'target' for all cameras")
            if self.targets is not None and camera.target not in known:
                raise ValueError(
                    f"cameras.{name}.target: expected one of {', '.join(known)}, "
                    f"found {camera.target!r}"
                )
        for entry in (*known.values(), *((self.target,) if self.target else ())):
            check_point_count(entry)


RIG_SCHEMA = TypeAdapter(RigFile)
