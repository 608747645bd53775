"""One process at a time per output: a lock on a file beside it, `.NAME.lock`.

The operating system holds the lock (`flock`, on Windows a locked byte) and releases it
when its process ends in any way, so a killed run never blocks the next one. On network
disks this works where the disk supports locks between hosts. Where no lock can be taken
(an unwritable folder, a disk without locks) work goes on without one.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO

from hdr_nsff.core.errors import InputError

BUSY = (errno.EAGAIN, errno.EACCES, errno.EDEADLK)  # of a lock that another process holds
MAX_NOTE_BYTES = 500
POLL_SECONDS = 0.5  # between two looks at a lock that is waited for

_held: set[Path] = set()  # outputs that this process has locked


@contextmanager
def lock_output(output: Path | str, wait: bool = False) -> Iterator[None]:
    """Keep other processes out of `output`, a file or folder that need not exist yet.
    InputError where another one works there already; with `wait` it is waited for.

    Locks may be nested in one process: `run` calls verbs that lock again. Of processes
    under `torchrun`, which share an output, the first one locks.
    """
    place = absolute(output)
    if place in _held or os.environ.get("RANK", "0") != "0":
        yield
        return
    made = missing_parents(place)
    file = acquire(place, wait)
    _held.add(place)
    try:
        yield
    finally:
        _held.discard(place)
        if file is not None:
            release(file)
        for folder in made:  # for an output that was never written
            with contextlib.suppress(OSError):
                folder.rmdir()


def absolute(output: Path | str) -> Path:
    """The output without links, so that a lock has one name."""
    try:
        return Path(output).resolve()
    except (OSError, RuntimeError) as error:  # RuntimeError: a loop of links, to Python 3.12
        raise InputError(f"{output}: cannot be followed ({error}); choose another place") from error


def missing_parents(place: Path) -> list[Path]:
    """The folders above `place` that do not exist yet, the innermost first."""
    return [folder for folder in place.parents if not folder.exists()]


def acquire(place: Path, wait: bool) -> BinaryIO | None:
    """The open, locked file for `place`; None where no lock can be taken. InputError
    where another process holds it.
    """
    for path in (beside(place), in_temporary_folder(place)):
        with contextlib.suppress(OSError):
            return lock_file(path, place, wait)
    return None


def lock_file(path: Path, place: Path, wait: bool) -> BinaryIO:
    """Open and lock `path`, the lock file of `place`. OSError where that fails."""
    while True:
        try:
            file = open_locked(path)
        except BlockingIOError as error:
            if not wait:
                raise InputError(busy_sentence(place, path)) from error
            time.sleep(POLL_SECONDS)
            continue
        if is_current(file, path):
            write_note(file)
            return file
        file.close()  # its holder has just deleted it: lock the new one


def beside(place: Path) -> Path:
    """The lock's usual path: it stays out of the output folder, which a verb may demand
    to be empty.
    """
    return place.parent / f".{place.name[:200]}.lock"


def in_temporary_folder(place: Path) -> Path:
    """The lock's path where the parent folder is not writable, as with a volume that is
    mounted into a container.
    """
    digest = sha256(os.fsencode(place)).hexdigest()[:16]
    return Path(tempfile.gettempdir()) / f".hdr-nsff-{digest}.lock"


def open_locked(path: Path) -> BinaryIO:
    """Open and lock a file. BlockingIOError where another process holds the lock, other
    OSErrors where none can be taken here.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open("a+b")
    try:
        take_lock(file)
    except OSError as error:
        file.close()
        if error.errno in BUSY:
            raise BlockingIOError(error.errno, "locked", str(path)) from error
        raise
    return file


def take_lock(file: BinaryIO) -> None:
    """Lock an open file without waiting; OSError where it is locked or cannot be."""
    try:
        import fcntl
    except ImportError:  # Windows (not tried)
        import msvcrt

        file.seek(MAX_NOTE_BYTES)  # a byte beyond the note, which others may then read
        msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)  # type: ignore[attr-defined]
    else:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def is_current(file: BinaryIO, path: Path) -> bool:
    """Whether an open file is still the one at `path`."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), os.stat(path))
    except FileNotFoundError:
        return False


def write_note(file: BinaryIO) -> None:
    """Write who holds the lock into it, for the sentence that others get."""
    started = time.strftime("%Y-%m-%d %H:%M:%S")
    note = f"process {os.getpid()} on {socket.gethostname()} since {started}"
    with contextlib.suppress(OSError):  # a full disk
        file.truncate(0)
        file.write(note.encode()[:MAX_NOTE_BYTES])
        file.flush()


def busy_sentence(place: Path, path: Path) -> str:
    """What to tell the user about a lock that another process holds."""
    try:
        note = path.read_bytes()[:MAX_NOTE_BYTES].decode(errors="replace").strip()
    except OSError:
        note = ""
    holder = f" ({note})" if note else ""
    return f"another hdr-nsff works in {place}{holder}; wait until it has finished, or end it"


def release(file: BinaryIO) -> None:
    """Delete a lock file and unlock it, in this order: nobody can lock a file that is
    about to go.
    """
    with contextlib.suppress(OSError):  # Windows does not delete open files
        os.unlink(file.name)
    file.close()
