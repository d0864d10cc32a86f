"""Joins a run, receives its messages as read-only NumPy views, and publishes messages and images."""

import ctypes
import time
from typing import Any, Iterator, Optional, Union

import iceoryx2 as iox2
import numpy as np

from .layouts import LAYOUTS, MAX_IMAGE_BYTES, MAX_SIDE_PX, SCHEMA_VERSION, TOPICS, Header, Limits, Topic
from .runs import Run, RunError, find

# Numbers of invalid messages that one call drops.
_MAX_DROPS = 1000


def topic(name: str) -> Topic:
    """Returns the graph's topic of a name."""
    for known in TOPICS:
        if known.name == name:
            return known
    raise RunError(f"there is no topic `{name}`; all: {', '.join(known.name for known in TOPICS)}")


#: Limits for small messages of a user's own topic.
MESSAGES: Limits = topic("encoder/posterior").limits
#: Limits for images of a user's own topic.
IMAGES: Limits = topic("camera/frame").limits
#: Limits for messages of which a late receiver gets the latest one.
STATUS: Limits = topic("controller/action").limits


def join(run: Union[None, str, Run] = None, name: str = "python") -> "Node":
    """Joins a run, the run of a name, or the only living one, under the visible name `name`."""
    return Node(run if isinstance(run, Run) else find(run), name)


class Node:
    """A process's membership in a run. It must outlive its receivers and publishers."""

    def __init__(self, run: Run, name: str) -> None:
        self.run = run
        if not run.is_alive():
            raise RunError(f"run `{run.name}` has ended")
        iox2.set_log_level_from_env_or(iox2.LogLevel.Fatal)
        config = iox2.config.default()
        config.global_cfg.prefix = iox2.FileName.new(run.prefix)
        config.global_cfg.root_path = iox2.Path.new(str(run.folder))
        self._node = (
            iox2.NodeBuilder.new()
            .name(iox2.NodeName.new(name))
            .config(config)
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .create(iox2.ServiceType.Ipc)
        )

    def __enter__(self) -> "Node":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Leaves the run."""
        self._node = None

    def receiver(self, of: Topic) -> "Receiver":
        """Opens a topic to receive from. Its messages wake this process while it waits."""
        return Receiver(self, of)

    def publisher(self, of: Topic, max_bytes: int = MAX_IMAGE_BYTES) -> "Publisher":
        """Opens a topic to send on; `max_bytes` is the size of the largest image of an image topic."""
        return Publisher(self, of, max_bytes)

    def _services(self, of: Topic) -> Any:
        """Opens the services of a topic: that of its messages, and that of wake-ups."""
        _check_message(of)
        if self._node is None:
            raise RunError(f"run `{self.run.name}` was left")
        limits, name = of.limits, iox2.ServiceName.new(of.name)
        builder = self._node.service_builder(name)
        if of.is_image:
            builder = builder.publish_subscribe(iox2.Slice[ctypes.c_uint8]).user_header(of.message)
        else:
            builder = builder.publish_subscribe(of.message)
        try:
            messages = (
                builder.max_subscribers(limits.max_subscribers)
                .max_publishers(limits.max_publishers)
                .max_nodes(limits.max_nodes)
                .history_size(limits.history)
                .subscriber_max_buffer_size(limits.buffer)
                .subscriber_max_borrowed_samples(limits.borrowed)
                .enable_safe_overflow(True)
                .open_or_create()
            )
            events = (
                self._node.service_builder(name)
                .event()
                .max_listeners(limits.max_subscribers)
                .max_notifiers(limits.max_publishers)
                .max_nodes(limits.max_nodes)
                .event_id_max_value(0)
                .open_or_create()
            )
        except (iox2.PublishSubscribeOpenOrCreateError, iox2.EventOpenOrCreateError) as error:
            raise RunError(
                f"topic `{of.name}`: {error}. If its types are incompatible, the run has another version: "
                "use the package of that version"
            ) from error
        return messages, events


class Received:
    """A message in its sender's memory. The memory is in use until this object and all its arrays are gone."""

    def __init__(self, message: np.recarray, image: Optional[np.ndarray]) -> None:
        #: The message, read-only; fields are attributes: `message.header.frame_id`.
        self.message = message
        #: The image as (height, width, channel), read-only; None for a message without an image.
        self.image = image

    def header(self) -> Header:
        """Returns a copy of the header, for a message that is based on this one."""
        return Header.from_buffer_copy(self.message.header.tobytes())


class Receiver:
    """Receives the messages of a topic."""

    def __init__(self, node: Node, of: Topic) -> None:
        services, events = node._services(of)
        #: Number of messages that were dropped because they are of another version or run, or not valid.
        self.invalid = 0
        self.topic, self._node = of, node
        try:
            self._port = services.subscriber_builder().buffer_size(of.limits.buffer).create()
            self._listener = events.listener_builder().create()
        except (iox2.SubscriberCreateError, iox2.ListenerCreateError) as error:
            raise RunError(f"topic `{of.name}`: {error}: close another observer") from error
        self._dtype = np.dtype(of.message)

    def next(self) -> Optional[Received]:
        """Returns the oldest waiting valid message, or None."""
        for _ in range(_MAX_DROPS):
            try:
                sample = self._port.receive()
            except iox2.ReceiveError as error:
                most = self.topic.limits.borrowed
                raise RunError(f"topic `{self.topic.name}`: {error}: at most {most} messages can be held; copy arrays") from error
            if sample is None:
                return None
            received = self._read(sample)
            if received is not None:
                return received
            self.invalid += 1
            # Its memory is given back before the next one is taken.
            del sample
        return None

    def newest(self) -> Optional[Received]:
        """Returns the newest waiting message, or None if there is none or it is not valid. Older ones are dropped."""
        newest = self.next()
        while newest is not None and self._port.has_samples():
            del newest
            newest = self.next()
        return newest

    def wait(self, timeout_s: float) -> bool:
        """Sleeps until a message waits. Returns false at the end of the time, or at the end of the run."""
        end = time.monotonic() + timeout_s
        while not self._port.has_samples():
            left = min(end - time.monotonic(), 0.2)
            if left <= 0 or not self._node.run.is_alive():
                return False
            self._listener.timed_wait(iox2.Duration.from_secs_f64(left))
        return True

    def __iter__(self) -> Iterator[Received]:
        """Yields messages until the run ends."""
        while self._node.run.is_alive():
            if self.wait(1.0) and (received := self.next()) is not None:
                yield received

    def _read(self, sample: Any) -> Optional[Received]:
        """Returns views of a sample, or None if it is not valid."""
        address = sample.user_header_ptr if self.topic.is_image else sample.payload_ptr
        message = _view(sample, address, self._dtype.itemsize, self._dtype).reshape(()).view(np.recarray)
        header = message.header
        if header.schema_version != SCHEMA_VERSION or header.run_id != self._node.run.run_id:
            return None
        if not self.topic.is_image:
            return Received(message, None)
        payload = sample.payload()
        width, height = int(message.width_px), int(message.height_px)
        if not (0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX) or payload.len() != width * height * 3:
            return None
        image = _view(sample, payload.as_ptr(), payload.len(), np.dtype(np.uint8)).reshape(height, width, 3)
        return Received(message, image)


class Loan:
    """Memory of a publisher for one image; the receivers read it from there."""

    def __init__(self, sample: Any, image: np.ndarray) -> None:
        self._sample = sample
        #: The image as (height, width, channel), to be written; its bytes are not initialised.
        self.image = image


class Publisher:
    """Sends messages on a topic."""

    def __init__(self, node: Node, of: Topic, max_bytes: int) -> None:
        messages, events = node._services(of)
        self.topic, self._node, self._max_bytes, self._sequence = of, node, max_bytes, 0
        builder = (
            messages.publisher_builder()
            .max_loaned_samples(of.limits.loaned)
            .backpressure_strategy(iox2.BackpressureStrategy.DiscardData)
        )
        if of.is_image:
            builder = builder.initial_max_slice_len(max_bytes).allocation_strategy(iox2.AllocationStrategy.Static)
        try:
            self._port = builder.create()
            self._notifier = events.notifier_builder().create()
        except (iox2.PublisherCreateError, iox2.NotifierCreateError) as error:
            raise RunError(f"topic `{of.name}`: {error}: another publisher has it open") from error

    def send(self, message: ctypes.Structure) -> None:
        """Stamps the header (schema, run, sequence, publish time) and sends a copy of a message."""
        if self.topic.is_image:
            raise TypeError(f"`{self.topic.name}` has images: use `loan` and `send_image`")
        self._stamp(message)
        self._port.send_copy(message)
        self._wake()

    def loan(self, width_px: int, height_px: int) -> Loan:
        """Returns memory for an image."""
        if not self.topic.is_image:
            raise TypeError(f"`{self.topic.name}` has messages without images: use `send`")
        count = width_px * height_px * 3
        if not (0 < width_px <= MAX_SIDE_PX and 0 < height_px <= MAX_SIDE_PX) or count > self._max_bytes:
            raise ValueError(f"an image of {width_px} x {height_px} pixels exceeds the topic's {self._max_bytes} bytes")
        sample = self._port.loan_slice_uninit(count)
        image = _view(None, sample.payload_ptr, count, np.dtype(np.uint8), writeable=True)
        return Loan(sample, image.reshape(height_px, width_px, 3))

    def send_image(self, image: Union[Loan, np.ndarray], message: ctypes.Structure) -> None:
        """Sends a written loan, or a copy of an image (height, width, channel), with its description."""
        if not isinstance(image, Loan):
            image = np.asarray(image)
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
                raise ValueError(f"an image is uint8 (height, width, 3), not {image.dtype} {image.shape}")
            loan = self.loan(image.shape[1], image.shape[0])
            loan.image[:] = image
            image = loan
        if image._sample is None:
            raise ValueError("the loan has been sent")
        if (message.height_px, message.width_px) != image.image.shape[:2]:
            raise ValueError(f"{message.width_px} x {message.height_px} pixels do not match {image.image.shape}")
        self._stamp(message)
        sample, image._sample = image._sample, None
        # The memory belongs to the receivers from here on.
        image.image = np.zeros(0, np.uint8)
        ctypes.memmove(sample.user_header_ptr, ctypes.byref(message), ctypes.sizeof(message))
        sample.assume_init().send()
        self._wake()

    def _wake(self) -> None:
        """Wakes the receivers that wait. A dead one does not stop the sender."""
        self._sequence += 1
        try:
            self._notifier.notify()
        except iox2.NotifierNotifyError:
            pass

    def _stamp(self, message: ctypes.Structure) -> None:
        if type(message) is not self.topic.message:
            raise TypeError(f"`{self.topic.name}` takes {self.topic.message.__name__}, not {type(message).__name__}")
        header = message.header
        header.schema_version, header.run_id = SCHEMA_VERSION, self._node.run.run_id
        header.sequence, header.publish_time_ns = self._sequence, time.monotonic_ns()


def _view(owner: Any, address: int, size: int, dtype: np.dtype, writeable: bool = False) -> np.ndarray:
    """Returns an array over memory that `owner` keeps; the array keeps `owner`."""
    memory = (ctypes.c_uint8 * size).from_address(address)
    memory._owner = owner
    view = np.frombuffer(memory, dtype)
    view.flags.writeable = writeable
    return view


def _check_message(of: Topic) -> None:
    """Refuses a message type without a header or a name."""
    fields = getattr(of.message, "_fields_", None)
    if not fields or fields[0][:2] != ("header", Header):
        raise TypeError(f"{of.message.__name__} is not a ctypes.Structure whose first field is `header: carff.Header`")
    if of.message not in LAYOUTS and not callable(getattr(of.message, "type_name", None)):
        raise TypeError(f"{of.message.__name__} has no static method `type_name`, such as \"mine.{of.message.__name__}.v1\"")
