"""The hash of a file."""

from pathlib import Path

import pytest

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hashes import hash_file


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="Linux alone has it")
def test_a_file_that_cannot_be_read_is_named():
    with pytest.raises(InputError, match="/proc/self/mem: cannot be read"):
        hash_file(Path("/proc/self/mem"))


def test_pipes_and_devices_are_not_read_without_end():
    with pytest.raises(InputError, match="/dev/zero: missing, or no ordinary file"):
        hash_file(Path("/dev/zero"))
