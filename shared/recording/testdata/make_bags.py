#!/usr/bin/env python3
"""Writes the ROS 2 bags of the tests with another implementation: `pip install rosbags==0.11.9 numpy pillow`."""

import io
import shutil
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

HERE = Path(__file__).resolve().parent
STORE = get_typestore(Stores.ROS2_HUMBLE)
TYPES = STORE.types
SIDE_PX = 32
IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
TRANSFORMS, ODOMETRY, POSE = "tf2_msgs/msg/TFMessage", "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped"
START_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000
# The optical frame of a camera that looks along the vehicle's x: x right, y down, z forward.
FORWARD = (-0.5, 0.5, -0.5, 0.5)


def header(time_ns: int, frame: str) -> object:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id=frame)


def place(time_ns: int) -> tuple[object, object]:
    """Position and orientation of the vehicle: 2 m/s along y, turned to the left by 90 degrees."""
    point = TYPES["geometry_msgs/msg/Point"](x=5.0, y=2e-9 * (time_ns - START_NS), z=0.0)
    return point, TYPES["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.5**0.5, w=0.5**0.5)


def transform(time_ns: int, parent: str, child: str, position: tuple, rotation: tuple) -> object:
    turned = TYPES["geometry_msgs/msg/Quaternion"](*rotation)
    moved = TYPES["geometry_msgs/msg/Vector3"](*position)
    both = TYPES["geometry_msgs/msg/Transform"](translation=moved, rotation=turned)
    return TYPES["geometry_msgs/msg/TransformStamped"](header=header(time_ns, parent), child_frame_id=child, transform=both)


def pose_message(kind: str, time_ns: int, topic: str) -> object:
    """Poses are between the images' times. The camera is 1.5 m above the vehicle's origin."""
    time_ns -= PERIOD_NS // 2
    point, turned = place(time_ns)
    if topic == "/tf_static":
        return TYPES[TRANSFORMS](transforms=[transform(time_ns, "base", "camera", (0.0, 0.0, 1.5), FORWARD)])
    if kind == TRANSFORMS:
        position, rotation = (point.x, point.y, point.z), (turned.x, turned.y, turned.z, turned.w)
        return TYPES[kind](transforms=[transform(time_ns, "map", "base", position, rotation)])
    pose = TYPES["geometry_msgs/msg/Pose"](position=point, orientation=turned)
    if kind == POSE:
        return TYPES[kind](header=header(time_ns, "map"), pose=pose)
    with_covariance = TYPES["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
    zero = TYPES["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    twist = TYPES["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    twist = TYPES["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
    return TYPES[kind](header=header(time_ns, "map"), child_frame_id="base", pose=with_covariance, twist=twist)


def message(kind: str, number: int, time_ns: int) -> object:
    """Image `number` is red by its number, green throughout, and blue on its left half."""
    head = header(time_ns, "camera")
    rgb = np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8)
    rgb[..., 0], rgb[..., 1], rgb[:, : SIDE_PX // 2, 2] = 10 * number, 100, 200
    if kind == IMAGE:
        return TYPES[kind](header=head, height=SIDE_PX, width=SIDE_PX, encoding="bgr8", is_bigendian=0,
                           step=SIDE_PX * 3, data=rgb[..., ::-1].reshape(-1).copy())
    if kind == COMPRESSED:
        jpeg = io.BytesIO()
        Image.fromarray(rgb).save(jpeg, "JPEG", quality=95, subsampling=0)
        data = np.frombuffer(jpeg.getvalue(), np.uint8)
        return TYPES[kind](header=head, format="bgr8; jpeg compressed bgr8", data=data)
    if kind == INFO:
        centre = SIDE_PX / 2 - 0.5
        roi = TYPES["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return TYPES[kind](header=head, height=SIDE_PX, width=SIDE_PX, distortion_model="plumb_bob",
                           d=np.array([-0.05, 0.01, 0, 0, 0]), k=np.array([25, 0, centre, 0, 25, centre, 0, 0, 1.0]),
                           r=np.eye(3).reshape(-1), p=np.zeros(12), binning_x=0, binning_y=0, roi=roi)
    return TYPES["std_msgs/msg/String"](data="no image")


def bag(name: str, channels: dict[str, str], count: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            opened = [(writer.add_connection(topic, kind, typestore=STORE), kind) for topic, kind in channels.items()]
            for number in range(count):
                time_ns = START_NS + number * PERIOD_NS
                for connection, kind in opened:
                    if kind in (TRANSFORMS, ODOMETRY, POSE):
                        content = pose_message(kind, time_ns, connection.topic)
                    else:
                        content = message(kind, number, time_ns)
                    data = STORE.serialize_cdr(content, kind)
                    writer.write(connection, time_ns, data)
        shutil.copy(path / f"{name}.mcap", HERE)


bag("ros2-raw", {"/front/image_raw": IMAGE, "/front/camera_info": INFO}, 4)
bag("ros2-jpeg", {"/front/image_raw/compressed": COMPRESSED, "/front/camera_info": INFO}, 4)
bag("ros2-two", {"/front/image_raw": IMAGE, "/rear/image_raw": IMAGE}, 1)
bag("ros2-none", {"/chatter": "std_msgs/msg/String"}, 2)
CAMERA = {"/front/image_raw": IMAGE, "/front/camera_info": INFO}
bag("ros2-tf", CAMERA | {"/tf": TRANSFORMS, "/tf_static": TRANSFORMS}, 4)
bag("ros2-odometry", CAMERA | {"/odom": ODOMETRY, "/tf_static": TRANSFORMS}, 4)
bag("ros2-pose", CAMERA | {"/pose": POSE}, 4)
