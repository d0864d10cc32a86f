"""Reads and publishes the topics of a CARFF run, without copies.

    import carff

    with carff.join() as node:
        beliefs = node.receiver(carff.topic("prober/belief"))
        while beliefs.wait(1.0):
            print(beliefs.newest().message.hazard_probability)
"""

from .layouts import *  # noqa: F403
from .layouts import LAYOUTS, TOPICS, Limits, Topic
from .node import IMAGES, MESSAGES, STATUS, Loan, Node, Publisher, Received, Receiver, join, topic
from .runs import Run, RunError, find, runs

__all__ = [
    "IMAGES", "LAYOUTS", "MESSAGES", "STATUS", "TOPICS",
    "Limits", "Loan", "Node", "Publisher", "Received", "Receiver", "Run", "RunError", "Topic",
    "find", "join", "runs", "topic",
]


def _check_layouts() -> None:
    """Refuses a Python whose structures differ from those of the programs."""
    import ctypes

    for struct, (size, alignment, offsets) in LAYOUTS.items():
        found = {name: getattr(struct, name).offset for name, *_ in struct._fields_}
        if (ctypes.sizeof(struct), ctypes.alignment(struct), found) != (size, alignment, offsets):
            raise ImportError(f"the layout of {struct.__name__} differs: generate layouts.py again with `carff schema --python`")


_check_layouts()
