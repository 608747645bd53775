"""File names that stand in data (scene.json, transforms.json, a COLMAP model, an
export's note): the one way from such a name to a path.

Data come from elsewhere, so a name may lead out of its folder (`../`, an absolute path,
a link) or be none at all (NUL, half a character, 5,000 letters). Both are refused here,
before anything is opened.
"""

from __future__ import annotations

from pathlib import Path

from hdr_nsff.core.errors import InputError, shorten


def resolve_name(folder: Path | str, name: str, kind: str) -> Path:
    """The resolved path of `name` below `folder`, which need not exist.

    `kind` is what messages call the folder ("scene folder", "data set"). InputError for
    a name that leaves the folder, also through a link, or that no file can have.
    """
    try:
        path = (Path(folder) / name).resolve()
        path.is_file()  # fails where the name is too long
        inside = path.is_relative_to(Path(folder).resolve())
    except (OSError, ValueError, RuntimeError) as error:  # RuntimeError: a circle of links
        raise InputError(
            f"{folder}: {shorten(name)!r} cannot be the name of a file; restore what lists it"
        ) from error
    if not inside:
        raise InputError(
            f"{folder}: the file name {shorten(name)!r} points outside the {kind}; "
            "names must stay inside it"
        )
    return path
