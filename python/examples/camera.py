"""A camera in Python: publishes images on `camera/frame` of a run whose camera is another program.

The images are a moving pattern. Replace `image` with your driver; write into the loan, so that nothing is copied.

    python3 python/examples/camera.py [--run NAME] [--frames N]
"""

import argparse
import math
import time

import numpy as np

import carff

# Camera space (x right, y up, z back) to world space: 1.6 m above the ground, looking along +y.
WORLD_FROM_CAMERA = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 1.6, 0, 0, 0, 1]


def image(out: np.ndarray, number: int) -> None:
    """Writes image `number` into `out` (height, width, channel)."""
    rows, columns = np.ogrid[: out.shape[0], : out.shape[1]]
    out[..., 0], out[..., 1], out[..., 2] = rows, columns, 16 * number % 256


def main() -> None:
    parser = argparse.ArgumentParser(description="Publish images.")
    parser.add_argument("--run", help="name of the run; optional if only one runs")
    parser.add_argument("--frames", type=int, help="number of images; all until the end of the run by default")
    parser.add_argument("--rate", type=float, default=10.0, help="images per second")
    parser.add_argument("--side", type=int, default=128, help="width and height, pixels")
    args = parser.parse_args()
    side = args.side
    focal_px = side / 2 / math.tan(math.radians(60) / 2)  # the field of view of the trained camera
    intrinsics = carff.Intrinsics(fl_x_px=focal_px, fl_y_px=focal_px, cx_px=side / 2, cy_px=side / 2)
    unknown = carff.DatasetView(0, -1, -1, -1, -1, -1, -1, 0)
    with carff.join(args.run, "camera") as node:
        frames = node.publisher(carff.topic("camera/frame"), side * side * 3)
        number = 0
        while node.run.is_alive() and number != args.frames:
            loan = frames.loan(side, side)
            header = carff.Header(frame_id=number, capture_time_ns=time.monotonic_ns())
            image(loan.image, number)
            meta = carff.FrameMeta(header, side, side, intrinsics, dataset_view=unknown)
            meta.world_from_camera[:] = WORLD_FROM_CAMERA
            frames.send_image(loan, meta)
            number += 1
            time.sleep(1 / args.rate)
        print(f"{number} frames", flush=True)


if __name__ == "__main__":
    main()
