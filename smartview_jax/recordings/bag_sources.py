"""Say which topics and frames of a bag are read, and what they mean."""

import dataclasses
from collections.abc import Mapping

from ..robots import SerialArm
from .camera_names import ONE_CAMERA, by_camera, check_cameras


@dataclasses.dataclass(frozen=True)
class BagSources:
    """Topics and frames of a bag, by their meaning.

    Attributes:
        image: topic of the pictures; None for the only one. Of several cameras: the topic of each,
            by the camera's name.
        camera_info: topic of the known camera; None for the one next to the pictures, if there is.
            Of several cameras: the topics of some or all of them, by the camera's name.
        base, tool: frames of tf whose relative pose is the robot's; a bag without tf needs joint
            readings instead.
        robot: topic of the robot's poses, `base_from_tool`, instead of frames of tf.
        joints: topic of joint readings, which need an arm.
        joint_names: names of the arm's joints in its order, from base to tool; in the messages
            they may have another order, and further joints.
        arm: the arm of the joint readings. Without frames and without a topic of poses its
            kinematics gives the robot's poses.
        tag: topic or frame of a tag, whose poses are used instead of pictures.
        tag_id: id of the tag in messages that have several.
        camera: frame of the camera, in which the tag's pose is looked up; None for the frame in
            which it is published.
        received: whether the times of recording are used instead of the stamps of the messages.

    For example:

        >>> sources = sv.BagSources(image="/camera/image_raw", base="base_link", tool="tool0")
        >>> print(sources.camera_info, sources.received)
        None False
    """

    image: str | Mapping[str, str] | None = None
    camera_info: str | Mapping[str, str] | None = None
    base: str | None = None
    tool: str | None = None
    robot: str | None = None
    joints: str | None = None
    joint_names: tuple[str, ...] = ()
    arm: SerialArm | None = None
    tag: str | None = None
    tag_id: int | None = None
    camera: str | None = None
    received: bool = False

    def __post_init__(self) -> None:
        """Refuse contradictions, and a robot that is not stated."""
        if (self.base is None) != (self.tool is None):
            raise ValueError("base and tool: expected both frames or none")
        if self.base is not None and self.robot is not None:
            raise ValueError("robot: expected a topic of poses, or the frames base and tool")
        if (self.joints is None) != (self.arm is None):
            raise ValueError("joints and arm: expected both or none")
        if self.base is None and self.robot is None and self.joints is None:
            raise ValueError(
                "the robot's pose: expected the frames base and tool, a topic of poses (robot), or "
                "a topic of joint readings (joints) with the arm"
            )
        if self.tag is not None and (self.image is not None or self.camera_info is not None):
            raise ValueError("tag: poses of a tag are used instead of pictures: expected no image")
        if self.tag is None and (self.tag_id is not None or self.camera is not None):
            raise ValueError("tag_id and camera: expected with a tag only")
        self._check_cameras()

    def _check_cameras(self) -> None:
        """Refuse names and topics of several cameras that cannot be told apart."""
        images = self.images
        check_cameras(self.image, "topic")
        if unknown := [name for name in self.camera_infos if name not in images]:
            raise ValueError(
                f"camera_info: expected topics by the names of the cameras "
                f"({', '.join(images) if isinstance(self.image, Mapping) else 'one topic'}); "
                f"found {unknown[0] or self.camera_info!r}"
            )

    @property
    def images(self) -> dict[str, str | None]:
        """The topic of each camera's pictures; one camera has the name `ONE_CAMERA`."""
        return by_camera(self.image)

    @property
    def camera_infos(self) -> dict[str, str]:
        """The stated topics of known cameras, by the camera's name."""
        if isinstance(self.camera_info, Mapping):
            return dict(self.camera_info)
        return {} if self.camera_info is None else {ONE_CAMERA: self.camera_info}
