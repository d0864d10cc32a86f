#!/usr/bin/env python3
"""Writes the state dicts of these tests in the format of `torch.save`, without torch.

Usage: python3 make.py      (writes archive.pth, as PyTorch 1.6 and later do, and stream.pth, as earlier ones did)
"""

import collections
import io
import pickle
import struct
import sys
import types
import zipfile
from pathlib import Path

HERE = Path(__file__).resolve().parent


def module(name: str, **members: object) -> None:
    made = types.ModuleType(name)
    for key, value in members.items():
        if isinstance(value, type) or callable(value):
            value.__module__ = name
            value.__qualname__ = key
            value.__name__ = key
        setattr(made, key, value)
    sys.modules[name] = made


def rebuild(storage, offset, size, stride, requires_grad, hooks):
    raise NotImplementedError


FloatStorage, HalfStorage, LongStorage = (type(n, (), {}) for n in ("FloatStorage", "HalfStorage", "LongStorage"))
module("torch", FloatStorage=FloatStorage, HalfStorage=HalfStorage, LongStorage=LongStorage)
module("torch._utils", _rebuild_tensor_v2=rebuild)


class Storage:
    def __init__(self, key: str, kind: type, form: str, numbers: list) -> None:
        self.key, self.kind, self.count = key, kind, len(numbers)
        self.data = struct.pack(f"<{len(numbers)}{form}", *numbers)


class Tensor:
    def __init__(self, storage: Storage, size: tuple, stride: tuple) -> None:
        self.storage, self.size, self.stride = storage, size, stride

    def __reduce_ex__(self, protocol: int) -> tuple:
        return rebuild, (self.storage, 0, self.size, self.stride, False, collections.OrderedDict())


STORAGES = [
    Storage("0", FloatStorage, "f", [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]),
    Storage("1", HalfStorage, "e", [0.5, -2.0]),
    Storage("2", LongStorage, "q", [7]),
]
STATE = collections.OrderedDict(
    [
        ("whole.weight", Tensor(STORAGES[0], (2, 3), (3, 1))),
        ("turned.weight", Tensor(STORAGES[0], (3, 2), (1, 3))),
        ("half.bias", Tensor(STORAGES[1], (2,), (1,))),
        ("norm.num_batches_tracked", Tensor(STORAGES[2], (), ())),
    ]
)


def pickled(value: object, legacy: bool) -> bytes:
    out = io.BytesIO()

    class WithStorages(pickle._Pickler):
        def persistent_id(self, value: object) -> tuple | None:
            if not isinstance(value, Storage):
                return None
            entry = ("storage", value.kind, value.key, "cpu", value.count)
            return (*entry, None) if legacy else entry

    WithStorages(out, protocol=2).dump(value)
    return out.getvalue()


with zipfile.ZipFile(HERE / "archive.pth", "w", zipfile.ZIP_STORED) as archive:
    fixed = lambda name: zipfile.ZipInfo(f"archive/{name}", (1980, 1, 1, 0, 0, 0))
    archive.writestr(fixed("data.pkl"), pickled(STATE, legacy=False))
    archive.writestr(fixed("byteorder"), b"little")
    for storage in STORAGES:
        archive.writestr(fixed(f"data/{storage.key}"), storage.data)
    archive.writestr(fixed("version"), b"3\n")

with open(HERE / "stream.pth", "wb") as stream:
    sizes = {"short": 2, "int": 4, "long": 4}
    about = {"protocol_version": 1001, "little_endian": True, "type_sizes": sizes}
    for value in (0x1950A86A20F9469CFC6C, 1001, about):
        stream.write(pickled(value, legacy=True))
    stream.write(pickled(STATE, legacy=True))
    stream.write(pickled([storage.key for storage in STORAGES], legacy=True))
    for storage in STORAGES:
        stream.write(struct.pack("<q", storage.count) + storage.data)
