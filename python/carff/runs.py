"""Lists the living runs of this user."""

import fcntl
import os
import struct
from pathlib import Path
from typing import List, NamedTuple, Optional

# Longer paths do not fit into the addresses of sockets; the programs leave them out too.
_MAX_FOLDER_BYTES = 30
# Prefixes of longer integers in a record, with their formats.
_LONGER = {251: "<H", 252: "<I", 253: "<Q"}


class RunError(Exception):
    """No run, or several, or one that cannot be joined."""


class Run(NamedTuple):
    """A run with a living launcher."""

    name: str
    #: Id of the run, which is in every header.
    run_id: int
    #: Process id of the launcher.
    pid: int
    graph: Path
    dataset: Path
    checkpoint: Path
    started_unix_s: int
    #: Folder of the run's small files.
    folder: Path

    @property
    def prefix(self) -> str:
        """Prefix of the run's files in shared memory."""
        return f"carff{_fnv1a(os.fsencode(self.folder)) & 0xFFFFFFFF:08x}_"

    def is_alive(self) -> bool:
        """Returns true if its launcher is alive and still has this run."""
        found = _living(self.folder.parent, self.name)
        return found is not None and found.run_id == self.run_id


def runs() -> List[Run]:
    """Returns the living runs of this user, by name."""
    found = []
    for folder in _folders():
        try:
            names = [entry[: -len(".run")] for entry in os.listdir(folder) if entry.endswith(".run")]
        except (FileNotFoundError, PermissionError, NotADirectoryError):
            continue
        found += [run for name in names if (run := _living(folder, name))]
    return sorted(found)


def find(name: Optional[str] = None) -> Run:
    """Returns the run of a name, or the only living one."""
    living = runs()
    names = ", ".join(run.name for run in living) or "none"
    if name is not None:
        for run in living:
            if run.name == name:
                return run
        raise RunError(f"no run `{name}` is alive; living runs: {names}")
    if not living:
        raise RunError("no graph is running: start one with `carff launch` (as the same user)")
    if len(living) > 1:
        raise RunError(f"several graphs are running ({names}): name one")
    return living[0]


def _folders() -> List[Path]:
    """Returns the folders in which a run of this user may be, as the programs look for them."""
    env, user = os.environ.get, f"carff-{os.getuid()}"
    candidates = [
        env("RUNTIME_DIRECTORY", "").split(":")[0],
        env("XDG_RUNTIME_DIR") and os.path.join(env("XDG_RUNTIME_DIR", ""), "carff"),
        env("TMPDIR") and os.path.join(env("TMPDIR", ""), user),
        "/run/carff",
        os.path.join("/tmp", user),
    ]
    folders = []
    for folder in candidates:
        if folder and os.path.isabs(folder) and len(os.fsencode(folder)) <= _MAX_FOLDER_BYTES:
            # The hash of the path is the prefix in shared memory: the path stays as the programs write it.
            path = Path(folder)
            if path not in folders:
                folders.append(path)
    return folders


def _living(folder: Path, name: str) -> Optional[Run]:
    """Returns the run of a name if a launcher holds the lock of its record."""
    try:
        with open(folder / f"{name}.run", "rb") as file:
            record = file.read()
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
                return None
            except BlockingIOError:
                pass
    except OSError:
        return None
    try:
        return _parse(record, folder, name)
    except (IndexError, struct.error, UnicodeDecodeError):
        return None


def _parse(record: bytes, folder: Path, name: str) -> Run:
    """Reads a record: integers of variable length, and texts after their lengths."""
    at = 0

    def integer() -> int:
        nonlocal at
        first = record[at]
        at += 1
        if first < 251:
            return first
        form = _LONGER.get(first)
        if form is None:
            raise IndexError
        (value,) = struct.unpack_from(form, record, at)
        at += struct.calcsize(form)
        return value

    def text() -> str:
        nonlocal at
        length = integer()
        if at + length > len(record):
            raise IndexError
        at += length
        return record[at - length : at].decode()

    pid, run_id = integer(), integer()
    graph, dataset, checkpoint = Path(text()), Path(text()), Path(text())
    return Run(name, run_id, pid, graph, dataset, checkpoint, integer(), folder / name)


def _fnv1a(data: bytes) -> int:
    value = 0xCBF29CE484222325
    for byte in data:
        value = ((value ^ byte) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return value
