"""The hash of a file, by which a restart knows whether it has changed."""

from __future__ import annotations

import hashlib
from pathlib import Path

from hdr_nsff.core.errors import InputError


def hash_file(path: Path) -> str:
    """The sha256 of a file, in hexadecimal; InputError where it cannot be read."""
    if not path.is_file():  # pipes and devices may never end
        raise InputError(f"{path}: missing, or no ordinary file; copy it again")
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check its permissions, or copy it again"
        ) from error
