"""Checks the package on a running graph: python3 python/tests/attached.py RUN. Prints `ok` at the end."""

import ctypes
import sys
import time

import carff
import numpy as np

# Only a hanging graph exceeds it.
PATIENCE_S = 300.0
# Topics of a moving vehicle: a graph by itself publishes nothing on them.
VEHICLE = {"ego/pose", "ego/motion", "prober/look"}


def raises(error: type, text: str, call) -> None:
    try:
        call()
    except error as found:
        assert text in str(found), found
        return
    raise AssertionError(f"no {error.__name__} with `{text}`")


def one(node: carff.Node, name: str) -> carff.Received:
    receiver = node.receiver(carff.topic(name))
    assert receiver.wait(PATIENCE_S), f"no message on {name}"
    received = receiver.next()
    assert received is not None and receiver.invalid == 0, name
    header = received.message.header
    assert header.schema_version == carff.SCHEMA_VERSION and header.run_id == node.run.run_id
    assert 0 < header.publish_time_ns <= time.monotonic_ns()
    return received


def in_shared_memory(array: np.ndarray, prefix: str) -> bool:
    """Returns true if an array is in a file of the run in shared memory."""
    address = array.__array_interface__["data"][0]
    with open("/proc/self/maps") as maps:
        for line in maps:
            begin, end = (int(part, 16) for part in line.split()[0].split("-"))
            if begin <= address < end:
                return f"/dev/shm/{prefix}" in line
    return False


def read(node: carff.Node) -> None:
    """Every topic is read, as views of shared memory that cannot be written."""
    assert VEHICLE < {topic.name for topic in carff.TOPICS}
    for topic in carff.TOPICS:
        if topic.name in VEHICLE:
            assert not node.receiver(topic).wait(0.01), topic.name
            continue
        received = one(node, topic.name)
        assert in_shared_memory(received.message, node.run.prefix), topic.name
        assert not received.message.flags.writeable
        assert (received.image is not None) == topic.is_image
    frame = one(node, "camera/frame")
    assert frame.image.shape == (frame.message.height_px, frame.message.width_px, 3)
    assert in_shared_memory(frame.image, node.run.prefix) and frame.image.max() > 0
    raises(ValueError, "read-only", lambda: frame.image.__setitem__((0, 0, 0), 1))
    raises(ValueError, "read-only", lambda: frame.message.header.__setitem__("step", 1))
    belief = one(node, "prober/belief").message
    states = belief.state_probability[: int(belief.state_count)]
    assert belief.state_count == 6 and 0 < states.sum() <= 1.001, states
    assert 0 <= belief.hazard_probability <= 1 and belief.samples.shape == (carff.MAX_SAMPLES,)
    action = one(node, "controller/action").message
    carff.ActionCode(int(action.action)), carff.Reason(int(action.reason)), carff.Rule(int(action.rule))
    health = one(node, "health/encoder").message
    assert health.stage == carff.Stage.ENCODER and health.rss_bytes > 1_000_000


def refused(node: carff.Node) -> None:
    """Other layouts, names and versions are refused."""

    class Belief(ctypes.Structure):
        _fields_ = [("header", carff.Header), ("horizon", ctypes.c_uint32)]

        @staticmethod
        def type_name() -> str:
            return carff.Belief.type_name()

    class Renamed(ctypes.Structure):
        _fields_ = carff.Belief._fields_

        @staticmethod
        def type_name() -> str:
            return "carff.Belief.v1"

    class Nameless(ctypes.Structure):
        _fields_ = [("header", carff.Header)]

    class Headless(ctypes.Structure):
        _fields_ = [("value", ctypes.c_float)]

    limits = carff.topic("prober/belief").limits
    for message in (Belief, Renamed):
        raises(carff.RunError, "prober/belief", lambda: node.receiver(carff.Topic("prober/belief", message, False, limits)))
    for message in (Nameless, Headless, int):
        raises(TypeError, message.__name__, lambda: node.receiver(carff.Topic("x/y", message, False, limits)))
    raises(carff.RunError, "there is no topic", lambda: carff.topic("prober/beleif"))
    raises(carff.RunError, "no run `nowhere`", lambda: carff.join("nowhere"))


class Note(ctypes.Structure):
    """A message of a user's own."""

    _fields_ = [("header", carff.Header), ("value", ctypes.c_double)]

    @staticmethod
    def type_name() -> str:
        return "python-test.Note.v1"


def own(node: carff.Node) -> None:
    """Messages and images of a user's own topics arrive; those of another version or run are dropped and counted."""
    notes = carff.Topic("python-test/note", Note, False, carff.MESSAGES)
    receiver, publisher = node.receiver(notes), node.publisher(notes)
    assert not receiver.wait(0.01) and receiver.next() is None
    for value in (1.5, 2.5):
        publisher.send(Note(carff.Header(frame_id=7), value))
    assert receiver.wait(PATIENCE_S)
    first, second = receiver.next(), receiver.next()
    assert (first.message.value, second.message.value) == (1.5, 2.5)
    assert [int(r.message.header.sequence) for r in (first, second)] == [0, 1]
    assert first.header().frame_id == 7 and receiver.next() is None
    for version, run_id in ((carff.SCHEMA_VERSION + 1, node.run.run_id), (carff.SCHEMA_VERSION, 1)):
        publisher._port.send_copy(Note(carff.Header(schema_version=version, run_id=run_id), 3.5))
    assert receiver.next() is None and receiver.invalid == 2
    # A receiver holds as many messages as the topic allows, and one more after one is given back.
    held = [first, second]
    for value in range(4):
        publisher.send(Note(carff.Header(), value))
    held.append(receiver.next())
    raises(carff.RunError, "at most 3 messages can be held", receiver.next)
    del first, held[0]
    assert receiver.newest().message.value == 3
    raises(TypeError, "takes Note", lambda: publisher.send(carff.Posterior()))
    raises(TypeError, "use `send`", lambda: publisher.loan(2, 2))

    images = carff.Topic("python-test/image", carff.FrameMeta, True, carff.IMAGES)
    receiver, publisher = node.receiver(images), node.publisher(images, 4 * 2 * 3)
    sent = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    for image in (sent, publisher.loan(4, 2)):
        if isinstance(image, carff.Loan):
            assert in_shared_memory(image.image, node.run.prefix)
            image.image[:] = sent
        publisher.send_image(image, carff.FrameMeta(width_px=4, height_px=2))
        assert (receiver.next().image == sent).all()
    raises(ValueError, "exceeds", lambda: publisher.loan(5, 2))
    raises(ValueError, "do not match", lambda: publisher.send_image(sent, carff.FrameMeta(width_px=2, height_px=4)))
    raises(ValueError, "uint8", lambda: publisher.send_image(sent.astype(float), carff.FrameMeta()))
    # An array keeps its memory, also when all else is gone.
    publisher.send_image(sent, carff.FrameMeta(width_px=4, height_px=2))
    kept = receiver.next().image
    for value in range(20):
        publisher.send_image(np.full((2, 4, 3), value, np.uint8), carff.FrameMeta(width_px=4, height_px=2))
    assert (kept == sent).all()


def main() -> None:
    assert sys.argv[1] in [run.name for run in carff.runs()]
    with carff.join(sys.argv[1]) as node:
        assert node.run.is_alive() and node.run.graph.is_file()
        read(node)
        refused(node)
        own(node)
    print("ok")


if __name__ == "__main__":
    main()
