"""Bags of all formats, written by `rosbags` itself with the messages that a test wants."""

from typing import NamedTuple

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

FORMATS = ("ros1", "sqlite3", "mcap")

START = 1_700_000_000_000_000_000
"""Time of the first message, ns since 1970, as in a real recording."""

_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
"""Definition of a message that is not among ROS 1's common ones."""

stores = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed")


class Written(NamedTuple):
    """A message for a bag.

    Attributes:
        topic: its name.
        seconds: when it is recorded, from the start.
        kind: type, such as `tf2_msgs/msg/TFMessage`.
        fields: values by name; nested messages are dicts.
    """

    topic: str
    seconds: float
    kind: str
    fields: dict


def header(seconds, frame=""):
    nanoseconds = START + round(1e9 * seconds)
    stamp = {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}
    return {"stamp": stamp, "frame_id": frame}


def transform(pose):
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    turn = {"x": x, "y": y, "z": z, "w": w}
    return {"translation": dict(zip("xyz", pose[:3, 3], strict=True)), "rotation": turn}


def tf(seconds, parent, child, pose, static=False, late=0.0):
    stamped = {"header": header(seconds, parent), "child_frame_id": child}
    stamped["transform"] = transform(pose)
    topic = "/tf_static" if static else "/tf"
    return Written(topic, seconds + late, "tf2_msgs/msg/TFMessage", {"transforms": [stamped]})


def pose_stamped(topic, seconds, pose, frame="camera"):
    parts = transform(pose)
    fields = {"position": parts["translation"], "orientation": parts["rotation"]}
    content = {"header": header(seconds, frame), "pose": fields}
    return Written(topic, seconds, "geometry_msgs/msg/PoseStamped", content)


def picture(topic, seconds, pixels, encoding="mono8", late=0.0, **changes):
    pixels = np.asarray(pixels)
    fields = {
        "header": header(seconds, "camera"),
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "encoding": encoding,
        "is_bigendian": int(pixels.dtype.byteorder == ">"),
        "step": pixels.strides[0],
        "data": np.frombuffer(pixels.tobytes(), np.uint8),
    }
    return Written(topic, seconds + late, "sensor_msgs/msg/Image", fields | changes)


def compressed(topic, seconds, content, form="jpeg"):
    data = np.frombuffer(content, np.uint8)
    fields = {"header": header(seconds, "camera"), "format": form, "data": data}
    return Written(topic, seconds, "sensor_msgs/msg/CompressedImage", fields)


def joint_state(topic, seconds, names, positions):
    fields = {"header": header(seconds), "name": list(names), "velocity": np.zeros(0)}
    fields |= {"position": np.array(positions, dtype=float), "effort": np.zeros(0)}
    return Written(topic, seconds, "sensor_msgs/msg/JointState", fields)


def camera_info(topic, seconds, size, K, D=(), model="plumb_bob", P=None):
    K = np.asarray(K, dtype=float)
    P = np.column_stack([K, np.zeros(3)]) if P is None else P
    region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    fields = {"header": header(seconds, "camera"), "width": size[0], "height": size[1]}
    fields |= {"distortion_model": model, "binning_x": 0, "binning_y": 0, "roi": region}
    fields |= {"k": K.ravel(), "d": np.array(D, dtype=float), "p": P.ravel()}
    return Written(topic, seconds, "sensor_msgs/msg/CameraInfo", fields | {"r": np.eye(3).ravel()})


def write_bag(path, form, messages):
    """Write messages as a bag in one of `FORMATS`, and return its path."""
    if form == "ros1":
        from rosbags.rosbag1 import Writer

        store = stores.get_typestore(stores.Stores.ROS1_NOETIC)
        store.register(stores.get_types_from_msg(_TRANSFORMS, "tf2_msgs/msg/TFMessage"))
        path = path.with_suffix(".bag")
        writer, encode = Writer(path), store.serialize_ros1
    else:
        from rosbags.rosbag2 import StoragePlugin, Writer

        store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if form == "mcap" else StoragePlugin.SQLITE3
        writer = Writer(path, version=9, storage_plugin=plugin)
        encode = store.serialize_cdr
    connections = {}
    with writer:
        for message in sorted(messages, key=lambda message: message.seconds):
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.kind, typestore=store
                )
            content = _message(store, message.kind, message.fields)
            when = START + round(1e9 * message.seconds)
            writer.write(connections[message.topic], when, encode(content, message.kind))
    return path


def _message(store, kind, fields):
    """A message of a type, with nested messages from dicts; fields of ROS 1 are filled in."""
    definition = store.fielddefs[kind][1]
    values = {}
    for name, (_, detail) in definition:
        value = fields.get(name, fields.get(name.lower(), 0))
        # A node is a basic type, a name of a type, or a list of either.
        kind_name = detail if isinstance(detail, str) else detail[0][1]
        if isinstance(value, dict):
            value = _message(store, kind_name, value)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            value = [_message(store, kind_name, part) for part in value]
        values[name] = value
    return store.types[kind](**values)
