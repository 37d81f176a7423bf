"""MCAP files with messages of ROS 2: clouds as `sensor_msgs/PointCloud2`, and the sensors' frames as `/tf_static`.

Messages are written in CDR (little-endian XCDR1): members aligned to their size from the message's start, sequences and
strings behind their length. Definitions are those of ROS 2 (common_interfaces, geometry2).
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from io import BytesIO
from typing import Any

import numpy as np

from lidardesign.errors import ConfigError

SEPARATOR = "\n" + "=" * 80 + "\n"
TIME = "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec"
HEADER = "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id"
FIELD = (
    "MSG: sensor_msgs/PointField\nuint8 INT8=1\nuint8 UINT8=2\nuint8 INT16=3\nuint8 UINT16=4\nuint8 INT32=5\n"
    "uint8 UINT32=6\nuint8 FLOAT32=7\nuint8 FLOAT64=8\nstring name\nuint32 offset\nuint8 datatype\nuint32 count"
)
CLOUD = SEPARATOR.join(
    (
        "std_msgs/Header header\nuint32 height\nuint32 width\nPointField[] fields\nbool is_bigendian\n"
        "uint32 point_step\nuint32 row_step\nuint8[] data\nbool is_dense",
        HEADER, TIME, FIELD,
    )
)  # fmt: skip
TRANSFORMS = SEPARATOR.join(
    (
        "geometry_msgs/TransformStamped[] transforms",
        "MSG: geometry_msgs/TransformStamped\nstd_msgs/Header header\nstring child_frame_id\nTransform transform",
        "MSG: geometry_msgs/Transform\nVector3 translation\nQuaternion rotation",
        "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z",
        "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w",
        HEADER, TIME,
    )
)  # fmt: skip
# Every key is given: readers refuse a part of them. Late subscribers get what is transient local.
QOS = """- history: 3
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {{sec: 2147483647, nsec: 4294967295}}
  lifespan: {{sec: 2147483647, nsec: 4294967295}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 2147483647, nsec: 4294967295}}
  avoid_ros_namespace_conventions: false
"""
VOLATILE, TRANSIENT_LOCAL = 2, 1
DATATYPES = {"u1": 2, "u2": 4, "u4": 6, "f4": 7}
NANOSECONDS = 1_000_000_000


class Message:
    """A message that is being written."""

    def __init__(self) -> None:
        self.data = bytearray()

    def add(self, kind: str, *values: Any) -> None:
        """Numbers of one kind of `struct`, aligned to their size."""
        size = struct.calcsize(f"<{kind}")
        for value in values:
            self.data += b"\0" * (-len(self.data) % size) + struct.pack(f"<{kind}", value)

    def text(self, text: str) -> None:
        """A string, whose length counts its final zero."""
        content = text.encode() + b"\0"
        self.add("I", len(content))
        self.data += content

    def header(self, time_ns: int, frame: str) -> None:
        """A `std_msgs/Header`."""
        self.add("i", time_ns // NANOSECONDS)
        self.add("I", time_ns % NANOSECONDS)
        self.text(frame)

    def content(self) -> bytes:
        """The whole message behind its mark of the encoding."""
        return b"\0\1\0\0" + bytes(self.data)


def cloud_message(table: np.ndarray, time_ns: int, frame: str) -> bytes:
    """A table of points as `sensor_msgs/PointCloud2`."""
    message, kinds = Message(), table.dtype
    message.header(time_ns, frame)
    message.add("I", 1, len(table), len(kinds.names))
    for name in kinds.names:
        kind, offset = kinds.fields[name]
        message.text(name)
        message.add("I", offset)
        message.add("B", DATATYPES[kind.str[1:]])
        message.add("I", 1)
    message.add("?", False)
    message.add("I", kinds.itemsize, table.nbytes, table.nbytes)
    message.data += table.tobytes()
    message.add("?", bool(np.isfinite(table["x"]).all()))
    return message.content()


def transforms_message(parent: str, children: Sequence[tuple[str, Sequence[float], Sequence[float]]]) -> bytes:
    """Frames as `tf2_msgs/TFMessage`: each a name, a place [m] and a quaternion (w, x, y, z)."""
    message = Message()
    message.add("I", len(children))
    for name, place_m, (w, x, y, z) in children:
        message.header(0, parent)
        message.text(name)
        message.add("d", *map(float, place_m), x, y, z, w)
    return message.content()


def mcap_content(clouds: Sequence[tuple[int, bytes]], transforms: bytes) -> bytes:
    """An MCAP file of clouds at times [ns], and of the frames that hold all along.

    Raises:
        ConfigError: The library is not installed.
    """
    try:
        from mcap.writer import CompressionType, Writer
    except ImportError:
        raise ConfigError(
            "the library mcap is not installed",
            where="--format mcap",
            hint="pip install 'lidardesign[mcap]', or --format ply",
        ) from None
    file = BytesIO()
    # without compression the same messages are the same bytes with every version of the libraries
    writer = Writer(file, compression=CompressionType.NONE)
    writer.start(profile="ros2", library="lidardesign")
    channels = []
    for topic, name, text, depth, durability in (
        ("/points", "sensor_msgs/msg/PointCloud2", CLOUD, 10, VOLATILE),
        ("/tf_static", "tf2_msgs/msg/TFMessage", TRANSFORMS, 1, TRANSIENT_LOCAL),
    ):
        schema = writer.register_schema(name=name, encoding="ros2msg", data=text.encode())
        channels.append(
            writer.register_channel(
                topic, "cdr", schema, {"offered_qos_profiles": QOS.format(depth=depth, durability=durability)}
            )
        )
    writer.add_message(channels[1], log_time=0, publish_time=0, data=transforms)
    for time_ns, data in clouds:
        writer.add_message(channels[0], log_time=time_ns, publish_time=time_ns, data=data)
    writer.finish()
    return file.getvalue()
