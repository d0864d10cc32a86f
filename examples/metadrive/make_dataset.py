"""Renders the training set: every state of the crossing from a hundred fixed poses, with `transforms.json`.

A truck at one of four places on the main road, or none: two branches of four time steps.

    xvfb-run -a python make_dataset.py --out data/metadrive
"""

import argparse
import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from world import BUILDINGS, EGO_X, FOCAL_PX, LANE_Y, SIDE_PX, TRUCK_SIZE_M, World, look_at, roof_camera

PLACES_X = [-15.0, -10.6, -6.2, -1.8]
BRANCHES = ["truck", "no-truck"]
BOUNDS = [[-19.0, -19.5, 0.0], [6.0, 5.0, 5.4]]
# View 44 looks straight down.
ORBIT, OVERHEAD, ROOF, OPPOSITE, RIGHT_ARM = 44, 8, 36, 6, 6
SEED = 11
# Difference of a pixel's channel that shows the truck, of 255.
SHOWS = 8


def is_free(eye) -> bool:
    """Reports whether a camera is outside of all buildings, with a margin."""
    x, y, z = eye
    inside = [
        low[0] - 0.6 < x < high[0] + 0.6 and low[1] - 0.6 < y < high[1] + 0.6 and z < height_m + 0.6
        for low, high, height_m, _ in BUILDINGS
    ]
    return not any(inside)


def orbit(rng: np.random.Generator, number: int) -> np.ndarray:
    """A camera around the hidden part of the main road."""
    middle = np.array([-7.0, -2.5, 0.5])
    for _ in range(100):
        azimuth = number * math.pi * (3 - math.sqrt(5)) + rng.uniform(-0.2, 0.2)
        elevation, radius_m = math.radians(rng.uniform(24, 60)), rng.uniform(10.5, 18)
        out = [math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation)]
        eye = middle + radius_m * np.array(out)
        if is_free(eye):
            return look_at(eye, middle + rng.uniform(-1, 1, 3))
    raise RuntimeError("no free place for a camera")


def overhead(rng: np.random.Generator, number: int) -> np.ndarray:
    """A camera above the crossing; the first one looks straight down, with +Y up."""
    eye = np.array([-7.0, -5.0, 26.0])
    if number == 0:
        return look_at(eye, eye - [0, 0, 1], (0, 1, 0))
    return look_at(eye + [*rng.uniform(-4, 4, 2), 0], [*(eye[:2] + rng.uniform(-2, 2, 2)), 0], (0, 1, 0))


def roof(rng: np.random.Generator, number: int) -> np.ndarray:
    """A camera on the ego's roof, anywhere on its way up to the others' lane."""
    y = -18.0 + (number + rng.uniform()) * 13.0 / ROOF
    matrix = roof_camera(y, rng.uniform(8, 56), rng.uniform(2, 9), rng.uniform(1.85, 2.3), rng.uniform(-0.3, 0.6))
    matrix[0, 3] = EGO_X + rng.uniform(-0.3, 0.3)
    return matrix


def street(rng: np.random.Generator, low, high) -> np.ndarray:
    """A camera in a region next to the road that looks at the main road's left arm."""
    return look_at(rng.uniform(low, high), rng.uniform([-11, -2.5, 0.6], [-5, -1.0, 1.2]))


def cameras() -> list:
    """Returns all poses with their kinds."""
    rng = np.random.default_rng(SEED)
    poses = [("orbit", orbit(rng, i)) for i in range(ORBIT)]
    poses += [("bev", overhead(rng, i)) for i in range(OVERHEAD)]
    poses += [("dash", roof(rng, i)) for i in range(ROOF)]
    poses += [("street", street(rng, [-10, 3.8, 1.4], [4, 6.0, 2.2])) for _ in range(OPPOSITE)]
    poses += [("street", street(rng, [5.5, -3.0, 1.4], [13, 3.0, 2.4])) for _ in range(RIGHT_ARM)]
    return poses


def share_in_frame(world_from_camera: np.ndarray, x: float) -> float:
    """Returns the share of points in the truck's box that the image's frame contains."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 8)] * 3), -1).reshape(-1, 3) * TRUCK_SIZE_M
    points = grid + [x, LANE_Y, TRUCK_SIZE_M[2] / 2]
    right, up, back = ((points - world_from_camera[:3, 3]) @ world_from_camera[:3, :3]).T
    ahead = np.maximum(-back, 1e-6)
    half = SIDE_PX / 2 / FOCAL_PX
    return float(np.mean((back < 0) & (abs(right) < half * ahead) & (abs(up) < half * ahead)))


def differing(first: np.ndarray, second: np.ndarray) -> int:
    """Counts the pixels that show a difference."""
    return int((np.abs(first.astype(int) - second).max(2) > SHOWS).sum())


def render(world: World, pose: np.ndarray) -> tuple:
    """Returns the images without a truck and with one at each place."""
    truck = world.others[0].origin
    truck.hide()
    images = [world.image(pose)]
    truck.show()
    for x in PLACES_X:
        world.put_other(0, x)
        images.append(world.image(pose))
    return images[0], images[1:]


def observability(visible_px: int, whole_px: int, in_frame: float, is_equal: bool) -> dict:
    """Returns the dataset's keys about how much of the truck an image shows."""
    fraction = min(visible_px / whole_px, 1.0) * in_frame if whole_px else 0.0
    kind = "none" if is_equal else "full" if fraction >= 0.75 and visible_px >= 12 else "partial"
    return dict(observability=kind, visible_fraction=round(fraction, 4), actor_px=visible_px)


def frames_of(world: World, view: int, kind: str, pose: np.ndarray, out: Path) -> list:
    """Renders all states from a pose, and returns their frames."""
    clear, with_truck = render(world, pose)
    for building in world.buildings:
        building.origin.hide()
    open_clear, open_truck = render(world, pose)
    for building in world.buildings:
        building.origin.show()
    frames = []
    for branch in (0, 1):
        for timestamp, x in enumerate(PLACES_X):
            image = with_truck[timestamp] if branch == 0 else clear
            name = f"images/b{branch}_t{timestamp}_v{view:03}.png"
            Image.fromarray(image).save(out / name)
            shown_px = differing(clear, with_truck[timestamp])
            is_equal = bool((clear == with_truck[timestamp]).all())
            whole_px = differing(open_clear, open_truck[timestamp])
            frame = dict(file_path=name, branch=branch, timestamp=timestamp, view_id=view, view_kind=kind)
            frame |= observability(shown_px, whole_px, share_in_frame(pose, x), is_equal)
            frames.append(frame | dict(transform_matrix=pose.tolist()))
    return frames


def scenario() -> dict:
    """Returns the states and their boxes."""
    half_size = [side / 2 for side in TRUCK_SIZE_M]

    def boxes(branch: int, x: float) -> list:
        box = dict(name="truck", center=[x, LANE_Y, half_size[2]], half_size=half_size, yaw=0.0, dynamic=True)
        return [box] if branch == 0 else []

    states = [
        dict(branch=branch, timestamp=timestamp, boxes=boxes(branch, x))
        for branch in (0, 1)
        for timestamp, x in enumerate(PLACES_X)
    ]
    actions = dict(hazard="halt", clear="advance")
    return dict(
        name="metadrive-crossing",
        bounds=BOUNDS,
        branches=BRANCHES,
        timestamps=len(PLACES_X),
        bev_view=ORBIT,
        states=states,
        hazard_branches=[0],
        actions=actions,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="Render the training set.")
    parser.add_argument("--out", type=Path, required=True, help="folder of the dataset")
    out = parser.parse_args().out
    (out / "images").mkdir(parents=True, exist_ok=True)
    world, frames = World(1), []
    for view, (kind, pose) in enumerate(cameras()):
        frames += frames_of(world, view, kind, pose, out)
        print(f"view {view}: {kind}", flush=True)
    frames.sort(key=lambda frame: (frame["branch"], frame["timestamp"], frame["view_id"]))
    camera = dict(w=SIDE_PX, h=SIDE_PX, fl_x=FOCAL_PX, fl_y=FOCAL_PX, cx=SIDE_PX / 2, cy=SIDE_PX / 2)
    text = json.dumps(camera | dict(scenario=scenario(), frames=frames), indent=1)
    (out / "transforms.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
