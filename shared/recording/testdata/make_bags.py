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


def message(kind: str, number: int, time_ns: int) -> object:
    """Image `number` is red by its number, green throughout, and blue on its left half."""
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    header = TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id="camera")
    rgb = np.zeros((SIDE_PX, SIDE_PX, 3), np.uint8)
    rgb[..., 0], rgb[..., 1], rgb[:, : SIDE_PX // 2, 2] = 10 * number, 100, 200
    if kind == IMAGE:
        return TYPES[kind](header=header, height=SIDE_PX, width=SIDE_PX, encoding="bgr8", is_bigendian=0,
                           step=SIDE_PX * 3, data=rgb[..., ::-1].reshape(-1).copy())
    if kind == COMPRESSED:
        jpeg = io.BytesIO()
        Image.fromarray(rgb).save(jpeg, "JPEG", quality=95, subsampling=0)
        data = np.frombuffer(jpeg.getvalue(), np.uint8)
        return TYPES[kind](header=header, format="bgr8; jpeg compressed bgr8", data=data)
    if kind == INFO:
        centre = SIDE_PX / 2 - 0.5
        roi = TYPES["sensor_msgs/msg/RegionOfInterest"](x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return TYPES[kind](header=header, height=SIDE_PX, width=SIDE_PX, distortion_model="plumb_bob",
                           d=np.array([-0.05, 0.01, 0, 0, 0]), k=np.array([25, 0, centre, 0, 25, centre, 0, 0, 1.0]),
                           r=np.eye(3).reshape(-1), p=np.zeros(12), binning_x=0, binning_y=0, roi=roi)
    return TYPES["std_msgs/msg/String"](data="no image")


def bag(name: str, channels: dict[str, str], count: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            opened = [(writer.add_connection(topic, kind, typestore=STORE), kind) for topic, kind in channels.items()]
            for number in range(count):
                time_ns = 1_700_000_000_000_000_000 + number * 100_000_000
                for connection, kind in opened:
                    data = STORE.serialize_cdr(message(kind, number, time_ns), kind)
                    writer.write(connection, time_ns, data)
        shutil.copy(path / f"{name}.mcap", HERE)


bag("ros2-raw", {"/front/image_raw": IMAGE, "/front/camera_info": INFO}, 4)
bag("ros2-jpeg", {"/front/image_raw/compressed": COMPRESSED, "/front/camera_info": INFO}, 4)
bag("ros2-two", {"/front/image_raw": IMAGE, "/rear/image_raw": IMAGE}, 1)
bag("ros2-none", {"/chatter": "std_msgs/msg/String"}, 2)
