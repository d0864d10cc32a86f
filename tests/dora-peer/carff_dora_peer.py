#!/usr/bin/env python3
"""Sends and receives payloads through dora, for `carff bench ipc --dora`.

Needs the packages dora-rs, dora-rs-cli and pyarrow, of the Python that runs this file:

    python3 -m venv dora && dora/bin/pip install dora-rs==1.1.0 dora-rs-cli==1.1.0 pyarrow
    carff bench ipc --dora dora/bin/python tests/dora-peer/carff_dora_peer.py

`send FOLDER` starts a dataflow of two nodes with `dora run`, and reads commands from standard input. It answers
`open BYTES` with a dot, and `run COUNT sleeping|busy PAUSE_US` with the times (nanoseconds, u64). `end` ends it. As for
the other transports, the time starts before the sender hands its payload over, and ends after the receiver has read the
last byte. The receiver acknowledges through a socket, which is not part of the time. Both nodes run in Python, which
takes some microseconds of each time.
"""

import array
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

# Nodes find these sockets in the folder.
CONTROL, ACKNOWLEDGE = "dora.control", "dora.acknowledge"
# Longest wait for the dataflow's start, seconds.
PATIENCE_S = 30.0


def listen(path: Path) -> socket.socket:
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(path))
    server.listen(2)
    server.settimeout(PATIENCE_S)
    return server


def connect(path: Path) -> socket.socket:
    until = time.monotonic() + PATIENCE_S
    while True:
        client = socket.socket(socket.AF_UNIX)
        try:
            client.connect(str(path))
            return client
        except OSError:
            client.close()
            if time.monotonic() > until:
                raise
            time.sleep(0.02)


def exactly(connection: socket.socket, count: int) -> bytes:
    data = bytearray()
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise ConnectionError("the other end has closed its socket")
        data += part
    return bytes(data)


class Dataflow:
    """The two nodes, and their control sockets by role."""

    def __init__(self, folder: Path):
        script = Path(__file__).resolve()
        server = listen(folder / CONTROL)
        file = folder / "dora.yml"
        file.write_text(f"""nodes:
  - id: sender
    path: {sys.executable}
    args: {script} node-send {folder}
    outputs: [payload]
  - id: receiver
    path: {sys.executable}
    args: {script} node-receive {folder}
    inputs:
      payload: {{ source: sender/payload, queue_size: 4 }}
""")
        command = [str(Path(sys.executable).with_name("dora")), "run", str(file)]
        # dora logs two lines per payload otherwise.
        environment = os.environ | {"RUST_LOG": "error", "DORA_LOG_LEVEL": "error"}
        log = (folder / "dora.log").open("wb")
        self.process = subprocess.Popen(command, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                                        stdout=log, stderr=subprocess.STDOUT, start_new_session=True)
        self.nodes: dict[bytes, socket.socket] = {}
        try:
            while len(self.nodes) < 2:
                connection, _ = server.accept()
                self.nodes[exactly(connection, 1)] = connection
        except TimeoutError:
            self.end()
            sys.exit(f"the dora dataflow has not started: see {folder / 'dora.log'}")

    def ask(self, role: bytes, line: str) -> None:
        self.nodes[role].sendall(line.encode() + b"\n")

    def end(self) -> None:
        for node in self.nodes.values():
            node.close()
        try:
            os.killpg(self.process.pid, signal.SIGTERM)
        except ProcessLookupError:
            pass
        try:
            self.process.wait(5)
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)


def send(folder: Path) -> None:
    """Takes the benchmark's commands."""
    flow, out = Dataflow(folder), sys.stdout.buffer
    try:
        for line in sys.stdin:
            words = line.split()
            if words[:1] == ["open"]:
                flow.ask(b"s", line.strip())
                out.write(b".")
            elif words[:1] == ["run"]:
                count = int(words[1])
                flow.ask(b"r", f"run {count} {words[2]}")
                exactly(flow.nodes[b"r"], 1)
                flow.ask(b"s", line.strip())
                out.write(exactly(flow.nodes[b"r"], 8 * count))
            elif words[:1] == ["end"]:
                break
            else:
                sys.exit(f"no such command: {line}")
            out.flush()
    finally:
        flow.end()


def node_send(folder: Path) -> None:
    import numpy
    import pyarrow
    from dora import Node

    node, server = Node(), listen(folder / ACKNOWLEDGE)
    control = connect(folder / CONTROL)
    control.sendall(b"s")
    acknowledge, _ = server.accept()
    acknowledge.settimeout(None)
    payload = numpy.zeros(8, numpy.uint8)
    for line in control.makefile():
        words = line.split()
        if words[0] == "open":
            payload = numpy.arange(int(words[1]), dtype=numpy.int64).astype(numpy.uint8)
            continue
        for _ in range(int(words[1])):
            time.sleep(int(words[3]) / 1e6)
            payload[:8].view(numpy.uint64)[0] = time.monotonic_ns()
            node.send_output("payload", pyarrow.array(payload))
            exactly(acknowledge, 1)


def node_receive(folder: Path) -> None:
    import numpy
    from dora import Node

    node = Node()
    control, acknowledge = connect(folder / CONTROL), connect(folder / ACKNOWLEDGE)
    control.sendall(b"r")
    for line in control.makefile():
        _, count, waiting = line.split()
        times = array.array("Q")
        control.sendall(b".")
        while len(times) < int(count):
            event = node.try_recv() if waiting == "busy" else node.next()
            if event is None or event["type"] != "INPUT":
                # dora's threads need a core.
                os.sched_yield()
                continue
            read = event["value"].to_numpy(zero_copy_only=True)
            words = read[: len(read) // 8 * 8].view(numpy.uint64)
            words.sum()
            times.append(time.monotonic_ns() - int(words[0]))
            # The memory goes back to the sender before the acknowledgement.
            del read, words, event
            acknowledge.sendall(b".")
        control.sendall(times.tobytes())


if __name__ == "__main__":
    roles = {"send": send, "node-send": node_send, "node-receive": node_receive}
    if len(sys.argv) != 3 or sys.argv[1] not in roles:
        sys.exit(__doc__)
    roles[sys.argv[1]](Path(sys.argv[2]))
