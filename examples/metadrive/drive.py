"""Closed-loop drives through the MetaDrive crossing, by the decisions of a running graph.

Each frame: the world publishes the ego's motion and image, waits for the decision on this image, and moves on by
0.1 s. Only images, poses and the ego's motion are published.

    xvfb-run -a python drive.py --rule look --episodes 100 --seed 1 --json look.json
"""

import argparse
import json
import math
import signal
import subprocess
import sys
import time
from pathlib import Path

import carff
import numpy as np

from world import EGO_X, FOCAL_PX, FRAME_S, SIDE_PX, TRUCK_SIZE_M, Road, World, roof_camera

ROAD = Road()
ADVANCE_MPS, LIMIT_S, PATIENCE_S = 5.0, 40.0, 10.0
# Largest acceleration and braking that MetaDrive's vehicle reaches, and those that the ego uses, m/s².
ENGINE_MPS2, BRAKES_MPS2, BRAKING_MPS2 = 2.77, 11.0, 6.0
RESPONSE_S = 0.3
# Frame numbers of an episode.
FRAMES_PER_EPISODE = 100_000
MOST_OTHERS = 2
GRAPH_RULES = {
    "paper": ("paper", "stop"),
    "calibrated": ("calibrated", "stop"),
    "phantom": ("calibrated", "phantom"),
    "peek": ("calibrated", "peek"),
    "look": ("calibrated", "look"),
}


class Episode:
    """The random part of a drive; it depends on the seed and the number only."""

    def __init__(self, seed: int, number: int) -> None:
        rng = np.random.default_rng([seed, number])
        self.others, speed_mps, x = [], 5.0, 0.0
        for index in range(int(rng.integers(0, MOST_OTHERS + 1))):
            speed_mps = min(rng.uniform(3.0, 5.0), speed_mps)
            x = rng.uniform(-40.0, -8.0) if index == 0 else x - TRUCK_SIZE_M[0] - rng.uniform(3.0, 25.0)
            self.others.append((x, speed_mps))
        self.mount = [rng.uniform(*limits) for limits in ((46.0, 52.0), (2.0, 9.0), (1.85, 2.3), (-0.3, 0.6))]
        self.noise = rng

    def others_at(self, time_s: float) -> list:
        """Returns x and speed of the other vehicles."""
        return [(x + speed_mps * time_s, speed_mps) for x, speed_mps in self.others]


def noisy(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Adds the sensor noise of CARFF's cameras: read noise, exposure and white balance."""
    gain = (1 + 0.02 * rng.standard_normal()) * (1 + 0.01 * rng.standard_normal(3))
    values = image * gain + rng.standard_normal(3) + 2.0 * rng.standard_normal(image.shape)
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


class Graph:
    """A running graph, whose camera and vehicle is this process."""

    def __init__(self, args: argparse.Namespace) -> None:
        rule, approach = GRAPH_RULES[args.rule]
        command = [args.carff, "launch", args.graph, "--run", args.run]
        for key in ("dataset", "checkpoint"):
            command += [f"--{key}", getattr(args, key)] if getattr(args, key) else []
        for setting in [f"controller.rule={rule}", f"controller.approach={approach}", *args.set]:
            command += ["--set", setting]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        self.node = self._join(args.run)
        self.frames = self.node.publisher(carff.topic("camera/frame"), SIDE_PX * SIDE_PX * 3)
        self.motions = self.node.publisher(carff.topic("ego/motion"))
        self.actions = self.node.receiver(carff.topic("controller/action"))
        self.seed, self.latencies_ms = args.seed, []

    def _join(self, name: str):
        for _ in range(300):
            if self.process.poll() is not None:
                raise SystemExit(f"the graph has ended with {self.process.returncode}")
            try:
                return carff.join(name, "metadrive")
            except carff.RunError:
                time.sleep(0.2)
        raise SystemExit("the graph does not start")

    def warm_up(self, image: np.ndarray, pose: np.ndarray) -> None:
        """Publishes an image until all stages are ready and a decision on it arrives."""
        for frame_id in range(1, 61):
            if self.decide(frame_id, 1, image, pose, (0.0, ROAD.start_y), 1.0) is not None:
                self.latencies_ms.clear()
                return
        raise SystemExit("the graph does not decide")

    def decide(self, frame_id, take_start, image, pose, motion, patience_s=PATIENCE_S):
        """Publishes a frame, and returns the decision on it, or None."""
        header = carff.Header(frame_id=frame_id, capture_time_ns=time.monotonic_ns(), seed=self.seed)
        speed_mps, y = motion
        ways, crossing = (ROAD.stop_y - y, ROAD.clear_y - y), (EGO_X, ROAD.stop_y)
        self.motions.send(carff.EgoMotion(header, speed_mps, *ways, math.pi / 2, crossing, 0.0))
        intrinsics = carff.Intrinsics(FOCAL_PX, FOCAL_PX, SIDE_PX / 2, SIDE_PX / 2)
        view = carff.DatasetView(0, -1, -1, -1, -1, -1, -1, 0)
        meta = carff.FrameMeta(header, SIDE_PX, SIDE_PX, intrinsics, dataset_view=view, take_start=take_start)
        meta.world_from_camera[:] = pose.ravel()
        self.frames.send_image(image, meta)
        until = time.monotonic() + patience_s
        while self.actions.wait(until - time.monotonic()):
            while (received := self.actions.next()) is not None:
                action = received.message
                if action.is_decision and action.based_on_frame == frame_id:
                    self.latencies_ms.append(int(action.latency_ns) / 1e6)
                    return float(action.target_speed_mps)
        return None

    def close(self) -> None:
        self.node.close()
        self.process.terminate()
        self.process.wait()


def stopping_mps(way_m: float) -> float:
    """The speed from which a vehicle stops within a way."""
    return math.sqrt(2 * 3.5 * max(way_m, 0.0))


def oracle_mps(episode: Episode, time_s: float, y: float, speed_mps: float) -> float:
    """The target speed of a planner that knows the truth: it crosses where it keeps clear of all, else it waits."""
    at_s, at_y, mps = time_s, y, speed_mps
    passes = True
    while at_y < ROAD.clear_y:
        mps = min(mps + ENGINE_MPS2 * 0.05, ADVANCE_MPS)
        at_s, at_y = at_s + 0.05, at_y + mps * 0.05
        on_lane = ROAD.stop_y + 0.6 < at_y < ROAD.clear_y - 0.6
        passes &= not (on_lane and any(-3.2 < x < 6.6 for x, _ in episode.others_at(at_s)))
    committed = y >= ROAD.stop_y
    return ADVANCE_MPS if passes or committed else min(ADVANCE_MPS, stopping_mps(ROAD.stop_y - y - 0.6))


def throttle(target_mps: float, speed_mps: float) -> float:
    """MetaDrive's pedal for a target speed: throttle above 0, brake below."""
    wanted = min(max((target_mps - speed_mps) / RESPONSE_S, -BRAKING_MPS2), ENGINE_MPS2)
    if target_mps <= 0.0 and speed_mps < 0.2:
        return -0.1
    return wanted / ENGINE_MPS2 if wanted > 0 else wanted / BRAKES_MPS2


def drive(world: World, graph, rule: str, seed: int, number: int) -> dict:
    """Drives one episode, and returns its result."""
    episode, time_s, halted_s, missed, outcome = Episode(seed, number), 0.0, 0.0, 0, None
    take_start = (number + 1) * FRAMES_PER_EPISODE
    world.park()
    world.put_ego(ROAD.start_y, ADVANCE_MPS)
    while outcome is None:
        for index, (x, speed_mps) in enumerate(episode.others_at(time_s)):
            world.put_other(index, x, speed_mps)
        y, mps = world.place(world.ego)[1], float(world.ego.speed)
        if rule == "oracle":
            target_mps = oracle_mps(episode, time_s, y, mps)
        elif graph is None:
            target_mps = ADVANCE_MPS
        else:
            pose = roof_camera(y, *episode.mount)
            image = noisy(world.image(pose), episode.noise)
            target_mps = graph.decide(take_start + round(time_s / FRAME_S), take_start, image, pose, (mps, y))
            missed += target_mps is None
        world.env.step([0.0, throttle(target_mps or 0.0, mps)])
        time_s += FRAME_S
        halted_s += FRAME_S * (world.ego.speed < 0.15)
        if world.ego.crash_vehicle or world.ego.crash_building:
            outcome = "collided"
        elif world.place(world.ego)[1] >= ROAD.clear_y:
            outcome = "arrived"
        elif time_s >= LIMIT_S:
            outcome = "stuck"
    result = dict(episode=number, outcome=outcome, others=len(episode.others), time_s=round(time_s, 3))
    return result | dict(halted_s=round(halted_s, 3), missed_frames=missed)


def wilson(count: int, of: int) -> list:
    """Returns the 95 % Wilson interval of a share."""
    z, share = 1.96, count / of
    middle, half = share + z * z / (2 * of), z * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return [round(max((middle + sign * half) / (1 + z * z / of), 0.0), 4) for sign in (-1, 1)]


def figures(drives: list, latencies_ms: list) -> dict:
    """Returns the counts of some drives."""
    counts = {kind: sum(d["outcome"] == kind for d in drives) for kind in ("arrived", "collided", "stuck")}
    times = [d["time_s"] for d in drives if d["outcome"] == "arrived"]
    halted = [d["halted_s"] for d in drives]
    result = dict(episodes=len(drives), **counts, collided_interval=wilson(counts["collided"], len(drives)))
    result["halted_mean_s"] = round(float(np.mean(halted)), 3)
    result["missed_frames"] = sum(d["missed_frames"] for d in drives)
    for name, values in (("time_to_goal_s", times), ("latency_ms", latencies_ms)):
        if values:
            result[name] = dict(mean=round(float(np.mean(values)), 3))
            result[name] |= {f"p{p}": round(float(np.percentile(values, p)), 3) for p in (50, 95, 99)}
    return result


def main() -> None:
    parser = argparse.ArgumentParser(description="Drive through the MetaDrive crossing.")
    parser.add_argument("--rule", choices=["always-advance", "oracle", *GRAPH_RULES], default="look")
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="number of the first episode")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path, help="file of the results")
    parser.add_argument("--carff", default="target/release/carff", help="the program")
    parser.add_argument("--graph", default="examples/metadrive/graph.toml")
    parser.add_argument("--dataset", help="in place of the graph file's")
    parser.add_argument("--checkpoint", help="in place of the graph file's")
    parser.add_argument("--run", default="metadrive", help="name of the run")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the graph")
    args = parser.parse_args()
    # A terminated drive ends its graph, too.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    world = World(MOST_OTHERS)
    graph = Graph(args) if args.rule in GRAPH_RULES else None
    drives = []
    try:
        if graph is not None:
            pose = roof_camera(ROAD.start_y, 48.0, 5.0, 2.0, 0.0)
            graph.warm_up(noisy(world.image(pose), np.random.default_rng(0)), pose)
        for number in range(args.first, args.first + args.episodes):
            drives.append(drive(world, graph, args.rule, args.seed, number))
            print(json.dumps(drives[-1]), flush=True)
            if args.json:
                report = dict(rule=args.rule, seed=args.seed, first=args.first, settings=args.set)
                report |= figures(drives, graph.latencies_ms if graph else [])
                args.json.write_text(json.dumps(report | dict(drives=drives), indent=1) + "\n")
    finally:
        if graph is not None:
            graph.close()
    print(json.dumps(figures(drives, graph.latencies_ms if graph else []), indent=1))


if __name__ == "__main__":
    main()
