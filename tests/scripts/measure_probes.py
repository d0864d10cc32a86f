#!/usr/bin/env python3
"""Measures the cost of attaching and detaching probes for a running graph.

Usage: python3 tests/scripts/measure_probes.py [--rounds N] [--drives N] [--per-second R] [FOLDER OF THE PROGRAMS]

In each round (default 4) the shipped graph drives 60 times without and 60 times with probes, in alternating order. R
probes per second (default 4), at most three at a time, attach, receive a message, and detach or are killed with -9. The
program prints the latencies from camera to action of both, the number of probes that received a message, and the ratio
of the medians of the p99s. At the end nothing may be left of any run. Use an idle machine. This is not a test, because
it measures times.
"""

import argparse
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GRAPH = "configs/graphs/approaching-intersection.toml"
TOPICS = ["prober/belief", "controller/action", "camera/frame"]
AT_ONCE = 3
RUNS = Path("/tmp") / f"carff-{os.geteuid()}"
PATIENCE_S = 60


class Storm:
    """Probes that attach and detach until a stop is requested."""

    def __init__(self, carff: Path, run: str, per_second: float):
        self.carff, self.run = carff, run
        self.pause = AT_ONCE / per_second
        self.heard = self.killed = 0
        self.over = threading.Event()
        self.lock = threading.Lock()
        self.threads = [threading.Thread(target=self.work, args=(i,)) for i in range(AT_ONCE)]

    def work(self, number: int) -> None:
        turn = number
        begun = time.monotonic() + self.pause * number / AT_ONCE
        while not self.over.wait(max(0.0, begun - time.monotonic())):
            begun = max(begun + self.pause, time.monotonic())
            topic, kill = TOPICS[turn % len(TOPICS)], turn % 2 == 0
            turn += 1
            count = [] if kill else ["--count", "1"]
            probe = subprocess.Popen(
                [self.carff, "probe", "echo", topic, "--json", "--run", self.run, *count],
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            )
            # A probe without a run ends without output.
            heard = bool(probe.stdout.readline())
            if kill:
                probe.send_signal(signal.SIGKILL)
            probe.stdout.close()
            probe.wait()
            with self.lock:
                self.heard += heard
                self.killed += heard and kill

    def __enter__(self):
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self.over.set()
        for thread in self.threads:
            thread.join()


def held() -> set[Path]:
    """Returns the system resources that runs hold."""
    return {p for folder in (RUNS, Path("/dev/shm")) if folder.is_dir() for p in folder.iterdir()}


def drive(carff: Path, run: str, drives: int, per_second: float | None) -> tuple[dict, int, int]:
    """Returns a launch's latencies in milliseconds, and the numbers of probes with a message and of killed probes."""
    before, record = held(), RUNS / f"{run}.run"
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        launch = subprocess.Popen(
            [carff, "launch", GRAPH, "--run", run, "--drives", str(drives), "--report", report],
            cwd=ROOT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )
        heard = killed = 0
        if per_second:
            until = time.monotonic() + PATIENCE_S
            while not record.exists() and launch.poll() is None and time.monotonic() < until:
                time.sleep(0.01)
            with Storm(carff, run, per_second) as storm:
                while record.exists() and launch.poll() is None:
                    time.sleep(0.1)
            heard, killed = storm.heard, storm.killed
        if launch.wait() != 0:
            sys.exit(f"the graph ended with {launch.returncode}")
        latency = json.loads(report.read_text())["latency_ms"]["camera_to_action"]
    if left := held() - before:
        sys.exit(f"left behind by run {run}: {sorted(map(str, left))}")
    return latency, heard, killed


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--drives", type=int, default=60)
    parser.add_argument("--per-second", type=float, default=4)
    parser.add_argument("programs", nargs="?", default=ROOT / "target/release")
    args = parser.parse_args()
    carff = Path(args.programs).resolve() / "carff"
    ways: dict[bool, list[dict]] = {False: [], True: []}
    heard = killed = 0
    for number in range(args.rounds):
        # The second variant of a pair is the first of the next pair, so that no variant always follows the other.
        for storms in [False, True] if number % 2 == 0 else [True, False]:
            latency, more, ended = drive(carff, f"measured{number}{int(storms)}", args.drives,
                                          args.per_second if storms else None)
            ways[storms].append(latency)
            heard, killed = heard + more, killed + ended
            print(f"round {number + 1}, {'probes' if storms else 'none':6}: {json.dumps(latency)}", flush=True)
    p99 = {way: [latency["p99"] for latency in found] for way, found in ways.items()}
    ratio = statistics.median(p99[True]) / statistics.median(p99[False])
    print(f"{heard} probes received a message, {killed} of them were killed with -9")
    print(f"p99, ms: without probes {p99[False]}, with probes {p99[True]}; ratio of medians {ratio:.3f}")


if __name__ == "__main__":
    main()
