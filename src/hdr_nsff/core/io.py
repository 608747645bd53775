"""Files: atomic writing, JSON and npy, and one sentence for what the disk refuses.

Every file is written to a temporary one beside it, flushed to disk and renamed. A
process that is killed therefore leaves the old file or the new one, never half of one.
What it may leave is the temporary file: the next process that writes into the same
folder removes it.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import json
import os
import platform
import re
import secrets
import tempfile
import time
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.npy import map_npy

# Who writes a temporary file: the machine, the process, and a token of that process,
# since a restarted container gives the same numbers to other processes.
HOST = f"{zlib.crc32(platform.node().encode()):08x}"
TOKEN = secrets.token_hex(4)
TEMPORARY = re.compile(
    r"\.partial-(?P<host>[0-9a-f]{8})-(?P<pid>\d+)-(?P<token>[0-9a-f]{8})-\w{8}(\..*)?"
)
# Seconds after which a temporary file of another machine, whose processes cannot be
# seen from here, counts as left behind: longer than any file takes to write.
FOREIGN_AGE_S = 24 * 3600


@contextmanager
def atomic(path: Path | str) -> Iterator[Path]:
    """A temporary path beside `path`, renamed onto it once the block has ended.

    After an error it is removed instead. It has the same suffix as `path`, by which
    libraries choose the format.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent)
    prefix = f".partial-{HOST}-{os.getpid()}-{TOKEN}-"
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=path.suffix, dir=path.parent)
    os.close(handle)
    temporary = Path(name)
    try:
        yield temporary
        with open(temporary, "rb") as file:
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


@functools.cache
def remove_leftovers(folder: Path) -> None:
    """Remove the temporary files that killed processes have left in `folder`.

    Not in folders below it. Looks once per process and folder.
    """
    for path in folder.glob(".partial-*"):
        if is_leftover(path):
            with contextlib.suppress(OSError):  # a file that stays is no harm
                path.unlink()


def is_leftover(path: Path) -> bool:
    """Whether `path` is a temporary file of `atomic` whose process has ended."""
    found = TEMPORARY.fullmatch(path.name)
    if found is None:
        return False
    if found["host"] != HOST:
        return time.time() - path.stat().st_mtime > FOREIGN_AGE_S
    if int(found["pid"]) == os.getpid():
        return found["token"] != TOKEN
    return not is_alive(int(found["pid"]))


def holds_nothing(folder: Path) -> bool:
    """Whether a folder is empty, but for folders that are so too, and for unfinished
    files of killed processes.
    """

    def counts(path: Path) -> bool:
        is_folder = path.is_dir() and not path.is_symlink()
        return not (holds_nothing(path) if is_folder else is_leftover(path))

    return folder.is_dir() and not any(counts(path) for path in folder.iterdir())


def is_alive(pid: int) -> bool:
    """Whether a process of this number runs on this machine."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except PermissionError:  # it runs, for another user
        return True
    return True


FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
FORBIDDEN = (errno.EACCES, errno.EPERM, errno.EROFS)
IMPOSSIBLE = (errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP)
NO_FOLDER = (errno.ENOTDIR, errno.EEXIST)  # the first where it lies above the path
GONE = (errno.ENOENT, errno.ENOTEMPTY)
BROKEN = (errno.EIO,)


@contextmanager
def writing_to(place: Path | str) -> Iterator[None]:
    """Turns errors of the disk, the path and the memory into an InputError.

    A full disk, a place that cannot or may not be read or written, and memory that does
    not suffice. Complete files stay; nothing is half-written.
    """
    try:
        yield
    except InputError:
        raise
    except UnicodeEncodeError as error:
        raise InputError(
            f"{place}: a file name that is no UTF-8 text ({error.object[:80]!r}); rename the file"
        ) from error
    except Exception as error:  # OpenEXR, FFmpeg and safetensors have types of their own for it
        sentence = describe_memory_error(error) or describe_disk_error(error, place)
        if sentence is None:
            raise
        raise InputError(sentence) from error


def describe_memory_error(error: Exception) -> str | None:
    """The sentence for an `error` whose cause is too little memory, None for others.

    torch and OpenCV raise errors of other types than Python and numpy.
    """
    reason = " ".join(str(error).split())
    words = ("out of memory", "can't allocate memory", "Insufficient memory")
    if not isinstance(error, MemoryError) and not any(word in reason for word in words):
        return None
    advice = "free some, or ask for less: smaller frames or pictures, fewer rays or Gaussians"
    return f"the memory does not suffice ({shorten(reason, 200)}); {advice}"


def describe_disk_error(error: Exception, place: Path | str) -> str | None:
    """The sentence for an `error` whose cause is the disk or the path, None for others.

    `place`: the path to name where the error names none.
    """
    code = getattr(error, "errno", None)
    text = getattr(error, "strerror", None) or str(error).partition("\n")[0]
    path = str(path_of(error, place))[:200]
    disk_full = any(words in str(error) for words in ("No space left", "File too large"))
    if code in FULL or disk_full:
        advice = "free some space and run the same command again, it continues where it was"
        return f"{path}: the disk is full ({text}); {advice}"
    if code in FORBIDDEN:
        advice = "check its permissions, or choose another place"
        return f"{path}: may not be read or written ({text}); {advice}"
    blocking = file_in_the_way(Path(path)) if code in NO_FOLDER else None
    if blocking is not None:
        return f"{blocking}: is a file, where a folder is needed; choose another place"
    if code in IMPOSSIBLE:
        advice = "correct the path, or choose another place"
        return f"{path}: cannot be read or written ({text}); {advice}"
    if code in GONE:
        advice = "correct the path, or wait until no other hdr-nsff works there"
        return f"{path}: cannot be read or written ({text}); {advice}"
    if code in BROKEN:
        advice = "check the disk, or choose another place"
        return f"{path}: cannot be read or written ({text}); {advice}"
    return None


def file_in_the_way(path: Path) -> Path | None:
    """The path, or what lies above it, where that is a file; None where none is."""
    return next((place for place in (path, *path.parents) if place.is_file()), None)


def path_of(error: Exception, place: Path | str) -> Path:
    """The path that an error is about; `place` where the error names none.

    Of a temporary file its folder.
    """
    name = getattr(error, "filename", None)
    path = Path(name) if isinstance(name, str | os.PathLike) and name else Path(place)
    return path.parent if path.name.startswith(".partial-") else path


def write_text(path: Path | str, text: str) -> None:
    """Write `text` as UTF-8, atomically."""
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def write_json(path: Path | str, value: Any) -> None:
    """Write `value` as readable JSON, atomically."""
    write_text(path, json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n")


def read_json(path: Path | str) -> Any:
    """The content of a JSON file; ValueError where it is no JSON."""
    path = Path(path)
    if path.exists() and not path.is_file():  # a pipe would be waited for
        raise ValueError("no ordinary file")
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))  # Notepad writes a mark first
    except RecursionError as error:
        raise ValueError("nested too deeply") from error


def write_npy(path: Path | str, array: np.ndarray) -> None:
    """Write an array, atomically."""
    buffer = BytesIO()  # numpy writing to a file itself forgets why it could not
    np.save(buffer, array, allow_pickle=False)
    with atomic(path) as temporary:
        # Not `getbuffer`: where writing fails, Python 3.12.1 crashes when it collects
        # the view.
        temporary.write_bytes(buffer.getvalue())


def write_half(path: Path | str, array: np.ndarray) -> None:
    """Write a map in half precision, or in single where it holds larger values."""
    with np.errstate(over="ignore"):
        half = array.astype(np.float16)
    overflows = np.isinf(half).any()
    write_npy(path, array.astype(np.float32) if overflows else half)


def read_npy(path: Path | str) -> np.ndarray:
    """An array as it was written, memory-mapped, read-only."""
    if not Path(path).is_file():  # a pipe would be waited for
        raise InputError(f"{path}: missing; run `hdr-nsff prepare` again to make it")
    try:
        return map_npy(path)
    except Exception as error:  # many unrelated types, for a damaged header alone
        raise InputError(
            f"{path}: not a readable .npy array ({shorten(error)}); {how_to_restore(path)}"
        ) from error


SCENE_FILE = "scene.json"  # what makes a folder a scene folder
# folders of a scene folder, by the step of `prepare` that fills them
FOLDER_STEPS = {
    "images": "frames",
    "raw_flow": "flow",
    "undistorted_flow": "flow",
    "poses": "poses",
    "masks": "masks",
    "static_disparity": "static_depth",
    "static_confidence": "static_depth",
    "still": "static_depth",
    "refined_flow": "refined_flow",
    "mover_disparity": "movers",
    "mover_confidence": "movers",
    "disparity": "depth",
    "disparity_confidence": "depth",
}


def how_to_restore(path: Path | str) -> str:
    """How to restore a damaged file: in a scene folder, by the step that made it."""
    folder = Path(path).parent
    step = FOLDER_STEPS.get(folder.name)
    if step is None or not (folder.parent / SCENE_FILE).is_file():
        return "copy it again"
    return f"run `hdr-nsff prepare` with `--redo {step}`"
