"""Read from a bag the robot's motion, tracked poses, the camera, and the pictures' stamps.

One pass is enough. Of the pictures only stamps are kept, so that the memory needed does not grow
with their size.
"""

from array import array
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int64

from ..argument_checks import errors_at
from .bag import Bag, Message
from .bag_sources import BagSources
from .camera_names import ONE_CAMERA
from .picture_messages import COMPRESSED, IMAGE
from .robot_log import JointRecord, RobotLog
from .tag_messages import POSE_KINDS, pose_of, tag_poses
from .transform_tree import Chain, Samples, TransformTree, stamp_of

TF_KINDS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
CAMERA_INFO, JOINT_STATE = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/JointState"

_STATIC_TOPIC = "tf_static"

_USE_RECEIVED = "use the times of recording (received=True, or --received)"
"""What helps where stamps are missing or wrong."""
_BASE, _TOOL = "base", "tool"
"""Names of the frames of a topic of poses, which is looked up as tf is."""


class Measurements(NamedTuple):
    """The times of a camera's pictures, or the poses that a tracker measured.

    Attributes:
        topic: of the pictures; None for a tag.
        stamps: times of the pictures or measurements, ns, increasing.
        received: when each was recorded, ns.
        camera_info: a message with the known camera; None if there is none.
        tracked: `camera_from_world` of the tag at each time; None for pictures.
    """

    topic: str | None
    stamps: Int64[np.ndarray, "moments"]
    received: Int64[np.ndarray, "moments"]
    camera_info: Any | None = None
    tracked: Float[np.ndarray, "moments 4 4"] | None = None


class BagContent(NamedTuple):
    """Everything that the first pass over a bag finds.

    Attributes:
        cameras: the pictures of each camera by its name, or the poses of the tag.
        robot: the robot's motion.
        notes: sentences on what was used.
    """

    cameras: dict[str, Measurements]
    robot: RobotLog
    notes: tuple[str, ...]


def read_content(
    bag: Bag, sources: BagSources, progress: Callable[[str], None] | None = None
) -> BagContent:
    """Read everything but the pictures."""
    reader = _ContentReader(bag, sources)
    topics = reader.topics()
    for message in bag.messages(topics, "reading", progress):
        try:
            reader.add(message)
        except (ValueError, AttributeError) as error:
            raise ValueError(f"{bag.path}: topic {message.topic}: {error}") from error
    try:
        return reader.finished()
    except ValueError as error:
        prefix = "" if str(bag.path) in str(error) else f"{bag.path}: "
        raise ValueError(f"{prefix}{error}") from error


class _ContentReader:
    """Sorts the messages of one pass into what they are for."""

    def __init__(self, bag: Bag, sources: BagSources):
        self._bag, self._sources = bag, sources
        self._tree, self._robot_tree = TransformTree(), TransformTree()
        # By the topic of the pictures: stamps, and when they were recorded.
        self._stamps: dict[str, tuple[array[int], array[int]]] = {}
        self._tag_poses = TransformTree()
        self._tag_ids: set[int | None] = set()
        self._tag_frames: set[str] = set()
        self._lags: dict[str, array[int]] = {}
        # By the camera's name: topics, and the message with the known camera.
        self._images: dict[str, str] = {}
        self._infos: dict[str, str] = {}
        self._known: dict[str, Any] = {}
        self._tag: str | None = None
        self._robot = self._joints = None
        self._joint_record: JointRecord | None = None

    def topics(self) -> set[str]:
        """Return the topics to be read; a ValueError names one that is missing."""
        bag, sources = self._bag, self._sources
        if sources.tag is None:
            for name, topic in sources.images.items():
                self._images[name] = self._image_topic(topic)
                info = self._camera_topic(name, self._images[name])
                self._infos |= {} if info is None else {name: info}
            self._stamps = {topic: (array("q"), array("q")) for topic in self._images.values()}
        elif sources.tag in bag.kinds or f"/{sources.tag}" in bag.kinds:
            self._tag = bag.required(sources.tag, set(bag.kinds.values()), "tag")
            if bag.kinds[self._tag] in TF_KINDS:
                raise ValueError(f"{bag.path}: tag: for a pose in tf name the tag's frame")
        if sources.robot is not None:
            self._robot = bag.required(sources.robot, POSE_KINDS, "robot")
        if sources.joints is not None:
            assert sources.arm is not None
            self._joints = bag.required(sources.joints, (JOINT_STATE,), "joints")
            self._joint_record = JointRecord(self._joint_names(), sources.arm)
        wanted = {self._tag, self._robot, self._joints, *self._stamps, *self._infos.values()}
        if sources.base is not None or self._tag_is_frame:
            tf = bag.topics_of(TF_KINDS)
            if not tf and (self._joints is None or self._tag_is_frame):
                raise ValueError(
                    f"{bag.path}: no topic of tf ({TF_KINDS[0]}), where the frames would be; the "
                    f"bag has {bag.listed_topics()}"
                )
            wanted |= set(tf)
        return {topic for topic in wanted if topic is not None}

    def _joint_names(self) -> tuple[str, ...]:
        """Return the names of the arm's joints; a ValueError lists the topic's."""
        arm, names = self._sources.arm, self._sources.joint_names
        assert arm is not None
        assert self._joints is not None
        if len(names) == arm.joint_count == len(set(names)):
            return names
        # Drivers sort them by the alphabet, so that their order is not the arm's.
        first = next(self._bag.messages({self._joints}), None)
        listed = ", ".join(first.content.name) if first is not None else "none"
        raise ValueError(
            f"{self._bag.path}: joint_names: expected {arm.joint_count} different names, in the "
            f"order of the arm from its base, found {', '.join(names) or 'none'}; the topic has "
            f"{listed}"
        )

    @property
    def _tag_is_frame(self) -> bool:
        return self._sources.tag is not None and self._tag is None

    def _image_topic(self, stated: str | None) -> str:
        """Return the topic of the pictures; a ValueError lists them if it is not clear which."""
        bag = self._bag
        kinds = (IMAGE, COMPRESSED)
        if stated is not None:
            return bag.required(stated, kinds, "image")
        topics = bag.topics_of(kinds)
        if len(topics) != 1:
            listed = ", ".join(topics) if topics else f"none; the bag has {bag.listed_topics()}"
            raise ValueError(
                f"{bag.path}: image: expected the name of a topic of pictures, or of one for each "
                f"of several cameras; there are {listed}"
            )
        return topics[0]

    def _camera_topic(self, name: str, image: str) -> str | None:
        """Return the topic of a known camera, by default the one next to its pictures."""
        bag, stated = self._bag, self._sources.camera_infos
        if name in stated:
            return bag.required(stated[name], (CAMERA_INFO,), "camera_info")
        above = image.split("/")[:-1]
        # Compressed pictures are one level further down, at image_raw/compressed.
        candidates = ["/".join([*above[:k], "camera_info"]) for k in (len(above), len(above) - 1)]
        known = bag.topics_of((CAMERA_INFO,))
        return next((topic for topic in candidates if topic in known), None)

    def add(self, message: Message) -> None:
        """Sort in one message."""
        topic, content = message.topic, message.content
        if topic in self._stamps:
            stamps, received = self._stamps[topic]
            stamps.append(self._stamp(message))
            received.append(message.received)
        elif topic in self._infos.values():
            for name in (name for name, info in self._infos.items() if info == topic):
                self._known.setdefault(name, content)
        elif topic == self._tag:
            self._add_tags(message)
        elif topic == self._robot:
            stamp = self._stamp(message)
            self._robot_tree.add(_BASE, _TOOL, stamp, pose_of(content))
        elif topic == self._joints:
            assert self._joint_record is not None
            self._joint_record.add(content, self._stamp(message))
        else:
            self._add_transforms(message)

    def _stamp(self, message: Message) -> int:
        """Return the time of a message, ns, and keep how late it was recorded."""
        stamp = stamp_of(message.content.header)
        self._lags.setdefault(message.topic, array("q")).append(message.received - stamp)
        return message.received if self._sources.received else stamp

    def _add_tags(self, message: Message) -> None:
        """Keep the pose of the tag with the wanted id, or of the only tag."""
        stamp = self._stamp(message)
        self._tag_frames.add(message.content.header.frame_id)
        for identity, numbers in tag_poses(message.content):
            self._tag_ids.add(identity)
            if self._sources.tag_id in (None, identity):
                self._tag_poses.add(_BASE, _TOOL, stamp, numbers)
        if self._sources.tag_id is None and len(self._tag_ids) > 1:
            ids = ", ".join(map(str, sorted(self._tag_ids, key=str)))
            raise ValueError(f"tag_id: expected the id of one of several tags; there are {ids}")

    def _add_transforms(self, message: Message) -> None:
        static = message.topic.rstrip("/").endswith(_STATIC_TOPIC)
        transforms = message.content.transforms
        if not static and len(transforms):
            lag = message.received - stamp_of(transforms[0].header)
            self._lags.setdefault("tf", array("q")).append(lag)
        received = message.received if self._sources.received else None
        self._tree.add_message(message.content, static, received)

    def finished(self) -> BagContent:
        """Return what was found."""
        notes: list[str] = []
        robot = self._finished_robot(notes)
        if self._sources.tag is None:
            cameras = {
                name: self._finished_pictures(topic, notes)._replace(
                    camera_info=self._known.get(name)
                )
                for name, topic in self._images.items()
            }
        else:
            cameras = {ONE_CAMERA: self._finished_tags(notes)}
        if not len(robot.stamps):
            raise ValueError("the robot's pose is known at no time")
        notes += self._clock_notes()
        for camera in cameras.values():
            self._refuse_apart(camera, robot.stamps)
        return BagContent(cameras, robot, tuple(notes))

    def _finished_robot(self, notes: list[str]) -> RobotLog:
        sources = self._sources
        chain: Chain | None = None
        if sources.base is not None and (self._tree.frames or self._joints is None):
            assert sources.tool is not None
            chain = self._tree.chain(sources.base, sources.tool)
            if all(link.static for link in chain.links):
                raise ValueError(
                    f"frames {chain.words()}: all transforms are static: the robot does not move "
                    "between these frames"
                )
            notes.append(f"robot: tf from {chain.words()}")
            notes += self._dropped_notes(chain)
        elif self._robot is not None:
            if not self._robot_tree.frames:
                raise ValueError(f"topic {self._robot} has no messages")
            chain = self._robot_tree.chain(_BASE, _TOOL)
            notes.append(f"robot: poses of {self._robot}")
        joints = None
        if self._joint_record is not None:
            with errors_at(f"topic {self._joints}"):
                joints = self._joint_record.finished()
            notes.append(f"joints: {', '.join(sources.joint_names)} of {self._joints}")
        if chain is None:
            notes.append("robot: poses by the arm's kinematics")
        return RobotLog(chain, joints)

    def _finished_pictures(self, topic: str, notes: list[str]) -> Measurements:
        """Return times of the pictures, and when they were recorded, sorted and without repeats."""
        stamps, received = (np.frombuffer(times, np.int64) for times in self._stamps[topic])
        if not len(stamps):
            raise ValueError(f"topic {topic} has no pictures")
        if (unstamped := stamps == 0).any():
            raise ValueError(
                f"topic {topic}: {int(unstamped.sum())} of {len(stamps)} pictures have no "
                f"stamp; {_USE_RECEIVED}"
            )
        notes.append(f"pictures: {len(stamps)} of {topic}")
        steps = np.diff(stamps)
        if not self._sources.received and (steps < 0).any():
            notes.append(
                f"clock: the stamps of {topic} go back {np.count_nonzero(steps < 0)} times "
                f"from picture to picture, by up to {-steps.min() / 1e9:.3g} s: if they are not "
                f"the times of exposure, {_USE_RECEIVED}"
            )
        stamps, order = np.unique(stamps, return_index=True)
        return Measurements(topic, stamps, received[order])

    def _finished_tags(self, notes: list[str]) -> Measurements:
        """Return the times and the poses of the tag in the camera's frame."""
        tag, camera = self._sources.tag, self._sources.camera
        assert tag is not None
        if self._tag is not None:
            if not self._tag_poses.frames:
                wanted = "" if self._sources.tag_id is None else f" with id {self._sources.tag_id}"
                ids = ", ".join(map(str, sorted(self._tag_ids, key=str))) or "none"
                raise ValueError(f"topic {self._tag}: no tag{wanted}; there are {ids}")
            samples = self._tag_poses.chain(_BASE, _TOOL).links[0].samples
            frames = ", ".join(sorted(self._tag_frames))
            notes.append(f"tag: poses of {self._tag} in the frame {frames}")
            if camera is not None and self._tag_frames != {camera}:
                raise ValueError(f"topic {self._tag}: its poses are in {frames}, not in {camera}")
            stamps = samples.stamps
            return Measurements(None, stamps, stamps, tracked=samples.at(stamps))
        try:
            parent = self._tree.parent_of(tag.lstrip("/"))
            chain = self._tree.chain(camera or parent or tag, tag)
        except ValueError as error:
            listed = self._bag.listed_topics()
            raise ValueError(f"tag: {error}; no topic has this name; there are {listed}") from error
        moving = [link.samples for link in chain.links if not link.static]
        if not moving:
            raise ValueError(f"tag: {chain.words()}: expected measurements over time in tf")
        # The last link is the detector's; the ones before, if any, are of the camera's mount.
        samples: Samples = moving[-1]
        poses = chain.at(samples.stamps)
        known = ~np.isnan(poses).any(axis=(1, 2))
        notes.append(f"tag: tf from {chain.words()}")
        notes += self._dropped_notes(chain)
        stamps = samples.stamps[known]
        return Measurements(None, stamps, stamps, tracked=poses[known])

    def _dropped_notes(self, chain: Chain) -> list[str]:
        """Return sentences on the transforms of a chain that were dropped."""
        counts = (
            (link, self._tree.dropped.get((link.parent, link.child), 0)) for link in chain.links
        )
        return [
            f"tf: {count} transforms of {link.child} in {link.parent} are no poses: left out"
            for link, count in counts
            if count
        ]

    def _clock_notes(self) -> list[str]:
        """Return how late messages were recorded after their stamps, by topic."""
        lags = {
            topic: np.array([np.median(lag), min(lag), max(lag)]) / 1e6
            for topic, lag in self._lags.items()
        }
        if self._sources.received:
            return ["clock: times of recording, not stamps"]
        listed = ", ".join(
            f"{topic} {median:.0f} ms ({least:.0f} to {greatest:.0f})"
            for topic, (median, least, greatest) in lags.items()
        )
        return [f"clock: recorded after their stamps: {listed}"] if lags else []

    def _refuse_apart(self, camera: Measurements, stamps: Int64[np.ndarray, "stamps"]) -> None:
        """Raise a ValueError if no picture or measurement is within the robot's log."""
        moments = camera.stamps
        if moments[0] > stamps[-1] or moments[-1] < stamps[0]:
            begin, end = (moments[[0, -1]] - stamps[0]) / 1e9
            raise ValueError(
                f"the stamps of {camera.topic or self._sources.tag} are from {begin:.6g} to "
                f"{end:.6g} s after the robot's first pose, its poses from 0 to "
                f"{(stamps[-1] - stamps[0]) / 1e9:.6g} s: do the computers' clocks differ? Then "
                f"{_USE_RECEIVED}"
            )
