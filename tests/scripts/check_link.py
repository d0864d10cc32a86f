#!/usr/bin/env python3
"""Drives on one host and observes from another, connected only by carff-link.

Usage (as root): python3 tests/scripts/check_link.py [FOLDER OF THE PROGRAMS]     (default: target/release)

Both hosts are on one machine. Each has its own network, shared memory and folder of runs. A pair of virtual network
cards connects them, and the second host's monotonic clock is ahead by a million seconds. Requirements:

- Beliefs, actions and views arrive unchanged, except for the run and the times, which move by the clocks' difference.
  Probes and recorder work on the desk.
- On the vehicle no link publishes, and nothing listens. On the desk the link listens only on the given address.
- A slow link loses and reports messages. A cut link delivers none, and delivers again when it is restored. The vehicle
  continues to decide meanwhile, and when the sender is killed.
- A renderer on the desk renders the vehicle's beliefs.
- At the end nothing is left in shared memory on either host.

If the system does not allow such hosts, the program reports that nothing was checked.
"""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "target/release").resolve()
GRAPH = "configs/graphs/approaching-intersection.toml"
RUNS = Path("/tmp") / f"carff-{os.geteuid()}"
VEHICLE, DESK, PORT = "10.77.0.1", "10.77.0.2", 7447
AHEAD_S = 1_000_000
PATIENCE_S = 120
# Header fields whose values differ between machines.
OF_THE_PLACE = {"read_ns", "run_id", "capture_time_ns", "publish_time_ns", "valid_until_ns", "last_progress_ns"}


def say(text: str) -> None:
    print(f"check: {text}", flush=True)


class Host:
    """A network, shared memory and a folder of runs, for as long as its first process lives."""

    def __init__(self, name: str, ahead_s: int = 0):
        self.name = name
        self.processes: list[Process] = []
        clock = ["--time", f"--monotonic={ahead_s}"] if ahead_s else []
        self.first = subprocess.Popen(
            ["unshare", "--net", "--mount", *clock, "--fork", "--kill-child", "sh", "-c", "echo $$; exec sleep infinity"],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        pid = self.first.stdout.readline().strip()
        if not pid:
            raise OSError(self.first.stderr.read().strip())
        kinds = ["--net", "--mount"] + (["--time"] if ahead_s else [])
        self.pid, self.enter = int(pid), ["nsenter", "--target", pid, *kinds, f"--wd={ROOT}", "--"]
        self.run("ip", "link", "set", "lo", "up")
        for folder, mode in [("/dev/shm", "1777"), (str(RUNS), "0700")]:
            self.run("mount", "-t", "tmpfs", "-o", f"mode={mode}", "tmpfs", folder)

    def run(self, *command: str) -> str:
        done = subprocess.run([*self.enter, *command], capture_output=True, text=True)
        if done.returncode != 0:
            raise OSError(f"{' '.join(command)}: {done.stderr.strip()}")
        return done.stdout

    def start(self, program: str, *args: str) -> "Process":
        process = Process(self, program, args)
        self.processes.append(process)
        return process

    def root(self) -> Path:
        return Path(f"/proc/{self.pid}/root")

    def shared(self) -> list[str]:
        """Returns all files of runs on this host."""
        folders = [self.root() / "dev/shm", self.root() / RUNS.relative_to("/")]
        return sorted(str(p) for folder in folders for p in folder.rglob("*"))

    def listening(self) -> set[str]:
        """Returns the addresses with listeners."""
        lines = Path(f"/proc/{self.pid}/net/tcp").read_text().splitlines()[1:]
        lines += Path(f"/proc/{self.pid}/net/tcp6").read_text().splitlines()[1:]
        found = [line.split()[1].split(":") for line in lines if line.split()[3] == "0A"]
        return {f"{'.'.join(str(b) for b in bytes.fromhex(a)[::-1])}:{int(port, 16)}" for a, port in found}

    def close(self) -> None:
        for process in self.processes:
            process.kill()
        self.first.kill()
        self.first.wait()


class Process:
    """A program on a host, with its output."""

    def __init__(self, host: Host, program: str, args: tuple[str, ...]):
        self.name, self.lines, self.messages = f"{host.name}: {program} {' '.join(args)}", [], []
        self.popen = subprocess.Popen(
            [*host.enter, str(PROGRAMS / program), *args],
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )
        self.reader = threading.Thread(target=self.read, daemon=True)
        self.reader.start()

    def read(self) -> None:
        for line in self.popen.stdout:
            if line.startswith("{"):
                self.messages.append(json.loads(line) | {"read_ns": time.monotonic_ns()})
            else:
                self.lines.append(line.rstrip())

    def said(self, words: str) -> str | None:
        return next((line for line in list(self.lines) if words in line), None)

    def end(self) -> int:
        """Ends the program like Ctrl-C."""
        self.popen.send_signal(signal.SIGINT)
        code = self.popen.wait(PATIENCE_S)
        self.reader.join()
        return code

    def kill(self) -> None:
        self.popen.kill()
        self.popen.wait()


class Check:
    """The two hosts and the checks on them."""

    def __init__(self, vehicle: Host, desk: Host):
        self.vehicle, self.desk = vehicle, desk

    def fail(self, text: str) -> None:
        for process in self.vehicle.processes + self.desk.processes:
            print(f"--- {process.name}\n" + "\n".join(process.lines[-15:]), file=sys.stderr)
        sys.exit(f"error: {text}")

    def until(self, what: str, condition) -> None:
        end = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > end or self.launch.popen.poll() is not None:
                self.fail(f"waited in vain until {what}")
            time.sleep(0.05)

    def must(self, what: str, holds: bool) -> None:
        if not holds:
            self.fail(f"it does not hold that {what}")

    def echo(self, host: Host, run: str, topic: str) -> Process:
        return host.start("carff", "probe", "echo", topic, "--json", "--run", run)

    def join_runs(self) -> None:
        self.launch = self.vehicle.start("carff", "launch", GRAPH, "--run", "car", "--drives", "600")
        self.until("the vehicle drives", lambda: self.launch.said("hazard "))
        self.receive = self.desk.start("carff-link", "receive", "--run", "car", "--as", "desk", "--graph", GRAPH,
                                       "--listen", f"{DESK}:{PORT}")
        self.until("the desk listens", lambda: self.receive.said("listening"))
        topics = ["belief", "action", "view"]
        self.here = {topic: self.echo(self.vehicle, "car", topic) for topic in topics}
        self.there = {topic: self.echo(self.desk, "desk", topic) for topic in topics}
        self.until("the vehicle is seen", lambda: all(p.messages for p in self.here.values()))
        self.images = []
        for host, run in [(self.vehicle, "car"), (self.desk, "desk")]:
            folder = RUNS / "images"
            host.start("carff", "probe", "image", "view", "-o", str(folder), "--run", run)
            self.images.append(host.root() / folder.relative_to("/"))
        self.send = self.link()
        self.until("messages arrive", lambda: all(len(p.messages) > 30 for p in self.there.values()))
        told = [line for line in self.receive.lines if "clock" in line]
        self.must(f"there is one sender: {told}", len(told) == 1)
        say(told[0].removeprefix("carff-link: "))

    def link(self, *args: str) -> Process:
        return self.vehicle.start("carff-link", "send", "--run", "car", "--connect", f"{DESK}:{PORT}", *args)

    def compare(self) -> None:
        for topic, there in self.there.items():
            sent = {m["header"]["sequence"]: m for m in list(self.here[topic].messages)}
            pairs = [(sent[m["header"]["sequence"]], m) for m in list(there.messages) if m["header"]["sequence"] in sent]
            self.must(f"{topic} is seen on both hosts", len(pairs) >= 20)
            shifts = []
            for before, after in pairs:
                self.must(f"{topic} is as it was:\n{before}\n{after}", of_any_place(before) == of_any_place(after))
                published = [m["header"]["publish_time_ns"] for m in (before, after)]
                shifts.append(published[1] - published[0])
                for key in ["capture_time_ns", "valid_until_ns"]:
                    times = [m.get(key, m["header"].get(key)) for m in (before, after)]
                    self.must(f"{key} of {topic} moves as all times of it do", None in times or times == [0, 0] or
                              times[1] - times[0] == shifts[-1])
            self.must("times are moved by the clocks' difference", all(abs(s / 1e9 - AHEAD_S) < 60 for s in shifts))
            off_ms = [(s - AHEAD_S * 1_000_000_000) / 1e6 for s in shifts]
            say(f"{topic}: {len(pairs)} messages as they were; times are moved by {off_ms[0]:.3f} ms too much at first, "
                f"{off_ms[-1]:.3f} ms in the end")
        before, after = self.images
        self.until("images are on both hosts", lambda: len(both(before, after)) >= 5)
        names = both(before, after)
        # The last file of each folder may be incomplete.
        same = [n for n in names[:-1] if (before / n).read_bytes() == (after / n).read_bytes()]
        self.must("images are as they were", len(same) == len(names) - 1)
        say(f"views: {len(same)} images as they were, byte for byte")

    def look_around(self) -> None:
        self.must("nothing listens on the vehicle", self.vehicle.listening() == set())
        self.must("the desk listens where it was told", self.desk.listening() == {f"{DESK}:{PORT}"})
        topics = json.loads(self.vehicle.run(str(PROGRAMS / "carff"), "probe", "list", "--run", "car", "--json",
                                             "--seconds", "1"))
        publishers = {p["name"] if isinstance(p, dict) else p for t in topics for p in t["publishers"]}
        self.must(f"stages alone publish on the vehicle: {publishers}", publishers and "link" not in publishers)
        recorded = self.desk.run(str(PROGRAMS / "carff"), "record", "-o", str(RUNS / "desk.mcap"), "--run", "desk",
                                 "--seconds", "3").strip()
        self.must(f"the desk records: {recorded}", int(re.search(r"(\d+) messages", recorded)[1]) > 30)
        say(f"nothing listens on the vehicle; the desk records: {recorded.split(': ')[-1]}")

    def actions(self, host: str = "here") -> list[dict]:
        return list(getattr(self, host)["action"].messages)

    def goes_on(self, while_what: str, since: int, count: int) -> None:
        """Waits until the vehicle has published `count` more actions, including decisions on new frames."""
        new = lambda: self.actions()[since:]
        numbers = lambda: [a["header"]["sequence"] for a in new()]
        self.until(f"the vehicle acts on, {while_what}", lambda: new() and numbers()[-1] - numbers()[0] >= count)
        decided = {a["based_on_frame"] for a in new() if a["is_decision"]}
        self.must(f"the vehicle decides on, {while_what}", len(decided) >= 3)
        pairs = [(a["header"], b["header"]) for a, b in zip(new(), new()[1:])]
        gaps = [(b["publish_time_ns"] - a["publish_time_ns"]) / 1e6 for a, b in pairs if b["sequence"] == a["sequence"] + 1]
        say(f"{while_what}: {numbers()[-1] - numbers()[0]} actions, {len(decided)} frames decided on; "
            f"{max(gaps):.0f} ms at most between two actions")

    def slow_down(self) -> None:
        since, seen = len(self.actions()), len(self.actions("there"))
        try:
            self.vehicle.run("tc", "qdisc", "add", "dev", "link0", "root", "tbf", "rate", "500kbit", "burst", "4kb",
                             "latency", "50ms")
        except OSError as error:
            say(f"a slow link was not checked: {error}")
            return
        self.until("the desk says what is lost", lambda: self.receive.said("lost on the way"))
        self.goes_on("while the link is slow", since, 60)
        ages_s = [m["read_ns"] / 1e9 + AHEAD_S - m["header"]["publish_time_ns"] / 1e9 for m in self.actions("there")[seen:]]
        say(f"actions are {max(ages_s):.2f} s old at most when they come")
        self.vehicle.run("tc", "qdisc", "del", "dev", "link0", "root")
        say(self.receive.said("lost on the way").removeprefix("carff-link: "))

    def cut(self) -> None:
        since = len(self.actions())
        self.vehicle.run("ip", "link", "set", "link0", "down")
        self.goes_on("while the link is cut", since, 100)
        self.until("the desk notices", lambda: any("nothing comes" in line for line in self.receive.lines[-2:]))
        stood = len(self.actions("there"))
        self.goes_on("while it stays cut", len(self.actions()), 60)
        self.must("nothing crosses a cut link", len(self.actions("there")) == stood)
        self.vehicle.run("ip", "link", "set", "link0", "up")
        began = time.monotonic()
        self.until("messages come again", lambda: len(self.actions("there")) > stood + 20)
        say(f"the link is whole again: 20 more actions after {time.monotonic() - began:.1f} s; "
            + [line for line in self.receive.lines if "come again" in line][-1].removeprefix("carff-link: "))

    def kill_sender(self) -> None:
        since, stood = len(self.actions()), len(self.actions("there"))
        self.send.kill()
        self.goes_on("when the sending end is killed", since, 60)
        stood = len(self.actions("there"))
        self.send = self.link("--topics", "forecast,belief,action")
        self.until("another one sends", lambda: len(self.actions("there")) > stood + 20)

    def render(self) -> None:
        run_id = re.search(r"--run-id (\d+)", self.receive.said("--run-id"))[1]
        seen = len(self.there["view"].messages)
        renderer = self.desk.start("carff-renderer", "--graph", GRAPH, "--run", "desk", "--run-id", run_id)
        self.until("the desk renders", lambda: len(self.there["view"].messages) >= seen + 20)
        views = self.there["view"].messages[seen:]
        beliefs = {(m["header"]["frame_id"], m["header"]["step"]) for m in list(self.there["belief"].messages)}
        of_beliefs = [v for v in views if (v["header"]["frame_id"], v["header"]["step"]) in beliefs]
        self.must("each view is of a belief that came", len(of_beliefs) == len(views))
        self.must("the renderer ends when it is told", renderer.end() == 0)
        say(f"a renderer on the desk: {len(views)} views of {len({v['header']['frame_id'] for v in views})} frames")

    def end(self) -> None:
        self.must("the sending end ends when it is told", self.send.end() == 0)
        self.must("the receiving end ends when it is told", self.receive.end() == 0)
        self.must("the vehicle ends when it is told", self.launch.end() == 130)
        for process in self.vehicle.processes + self.desk.processes:
            if "probe" in process.name:
                process.popen.wait(PATIENCE_S)
        # A run keeps its log and its times.
        kept = ("images", "desk.mcap", "car.log", "car.spans")
        left = [p for p in self.vehicle.shared() + self.desk.shared() if not any(name in p for name in kept)]
        self.must(f"nothing is left: {left}", not left)
        for process in [self.send, self.receive]:
            say("; ".join(line for line in process.lines if "carff-link" not in line))
        say("all well, nothing left")


def of_any_place(message: dict) -> dict:
    """Returns a message without the fields that differ between machines."""
    header = {k: v for k, v in message["header"].items() if k not in OF_THE_PLACE}
    return {k: v for k, v in message.items() if k not in OF_THE_PLACE} | {"header": header}


def both(before: Path, after: Path) -> list[str]:
    names = [{p.name for p in folder.glob("*.png")} if folder.is_dir() else set() for folder in (before, after)]
    return sorted(names[0] & names[1])


def main() -> None:
    if os.geteuid() != 0:
        sys.exit(print("skipped, nothing was checked: only root may make networks"))
    RUNS.mkdir(mode=0o700, exist_ok=True)
    hosts: list[Host] = []
    try:
        try:
            hosts.append(Host("vehicle"))
            hosts.append(Host("desk", AHEAD_S))
            vehicle, desk = hosts
            vehicle.run("ip", "link", "add", "link0", "type", "veth", "peer", "name", "link1", "netns", str(desk.pid))
            for host, card, address in [(vehicle, "link0", VEHICLE), (desk, "link1", DESK)]:
                host.run("ip", "address", "add", f"{address}/24", "dev", card)
                host.run("ip", "link", "set", card, "up")
        except OSError as error:
            sys.exit(print(f"skipped, nothing was checked: this system allows no hosts of their own: {error}"))
        check = Check(vehicle, desk)
        for step in [check.join_runs, check.compare, check.look_around, check.slow_down, check.cut, check.kill_sender,
                     check.render, check.end]:
            step()
    finally:
        for host in hosts:
            host.close()


if __name__ == "__main__":
    main()
