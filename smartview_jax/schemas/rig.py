"""Define the schema of a `dataset.yaml` with several cameras, which watched robots."""

from collections.abc import Collection
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, TypeAdapter, model_validator

from ..argument_checks import errors_at
from .calibration import ImageSize
from .dataset import (
    END_MARK,
    DepthPicturesEntry,
    DepthsEntry,
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
_CameraMount = Literal["eye_in_hand", "eye_to_hand", "hand_to_hand"]
CameraName = Annotated[
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
    """A camera: the size of its pictures, its mount, its target and arm by name, its depths.

    Of a camera on one hand that sees a target on another, `target_arm` carries the target.
    """

    image_size: ImageSize
    mount: _CameraMount | None = None
    target: PrintableText | None = None
    arm: PrintableText | None = None
    target_arm: PrintableText | None = None
    detections: DetectionsEntry | None = None
    depth_pictures: DepthPicturesEntry | None = None
    depths: DepthsEntry | None = None

    @model_validator(mode="after")
    def _check_arms(self) -> "RigCameraEntry":
        if (self.mount == "hand_to_hand") != (self.target_arm is not None):
            raise ValueError(
                "target_arm: expected the arm that carries the target for mount hand_to_hand, and "
                "none for other mounts"
            )
        if self.target_arm is not None and self.target_arm == self.arm:
            raise ValueError("target_arm: expected another arm than the camera's")
        return self

    @model_validator(mode="after")
    def _check_depths(self) -> "RigCameraEntry":
        if self.depth_pictures is not None and self.depths is not None:
            raise ValueError("depths: a camera with depth_pictures has none")
        if self.depth_pictures is not None and self.depth_pictures.camera is not None:
            raise ValueError(
                "depth_pictures.camera: leave it out; known cameras of a rig are given by --camera"
            )
        return self


class RobotEntries(Entry):
    """The tables of one arm's reports, and the rough poses of its targets."""

    poses: PosesEntry | None = None
    joints: JointsEntry | None = None
    base_from_world: RoughPose | None = None
    tool_from_world: RoughPose | None = None

    def check_robot(self, mounts: Collection[str]) -> None:
        """Raise a ValueError if no table states the poses, or one states a pose for no camera."""
        if self.poses is None and self.joints is None:
            raise ValueError("expected an entry 'poses', 'joints', or both")
        for name, mount in (
            ("base_from_world", "eye_in_hand"),
            ("tool_from_world", "eye_to_hand"),
        ):
            if getattr(self, name) is not None and mount not in mounts:
                raise ValueError(f"{name}: no camera is {mount}")


class RigFile(RobotEntries):
    """The description of a folder with several cameras.

    All cameras see the one `target`, or each its own of the `targets`. A camera without a mount
    has the folder's. Of several `arms`, each has its own tables, and each camera names its arm.
    """

    smartview_dataset: Literal[1]
    end_mark: Literal[True] | None = None
    cameras: Annotated[dict[CameraName, RigCameraEntry], Field(min_length=1)]
    target: TargetEntry | None = None
    targets: Annotated[dict[CameraName, TargetEntry], Field(min_length=1)] | None = None
    arms: Annotated[dict[CameraName, RobotEntries], Field(min_length=1)] | None = None
    mount: _Mount = "eye_in_hand"
    pictures: RigPicturesEntry | None = None
    end: Literal["smartview_dataset"] | None = None

    @model_validator(mode="after")
    def _check_consistency(self) -> "RigFile":
        if self.end_mark and self.end != END_MARK:
            raise ValueError(f"the last line, 'end: {END_MARK}', is missing: the file was cut")
        self._check_targets()
        self._check_arms()
        return self

    def _check_arms(self) -> None:
        """Raise a ValueError unless every arm has cameras and tables, and every camera an arm."""
        mounts = {name: camera.mount or self.mount for name, camera in self.cameras.items()}
        if self.arms is None:
            for name, camera in self.cameras.items():
                if camera.arm is not None or camera.target_arm is not None:
                    entry = "arm" if camera.target_arm is None else "target_arm"
                    raise ValueError(f"cameras.{name}.{entry}: the file has no 'arms'")
            self.check_robot(set(mounts.values()))
            return
        for name in RobotEntries.model_fields:
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: with several arms it is an entry of each of the 'arms'")
        for name, camera in self.cameras.items():
            entries = {"arm": camera.arm}
            entries |= {} if camera.target_arm is None else {"target_arm": camera.target_arm}
            for entry, arm in entries.items():
                if arm not in self.arms:
                    raise ValueError(
                        f"cameras.{name}.{entry}: expected one of {', '.join(self.arms)}, "
                        f"found {arm!r}"
                    )
        for arm, entries in self.arms.items():
            mounts_of_arm = {
                mounts[name]
                for name, camera in self.cameras.items()
                if arm in (camera.arm, camera.target_arm)
            }
            with errors_at(f"arms.{arm}"):
                entries.check_robot(mounts_of_arm)
            if not mounts_of_arm:
                raise ValueError(f"arms.{arm}: no camera names this arm")

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
