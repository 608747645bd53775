"""The CUDA kernels to machine code, by numba-cuda and the compiler's libraries that it
brings as wheels: no CUDA toolkit, no C compiler, no driver.

numba-cuda makes PTX, and nvJitLink makes of it what one kind of GPU runs. PTX alone
would need a driver as new as the compiler. It is what is left where nvJitLink does not
know the GPU, or is not there. Both are kept in the user's cache folder, under names
that change with the sources and the compiler. PTX is linked at a later start, if that
works by then.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Callable, Iterable
from functools import cache
from importlib import import_module, metadata
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hdr_nsff.fields.kernels import compositing, footprint, grid, moment, moment_gradients, pixel
from hdr_nsff.fields.kernels.cuda import layout

# groups of arguments of the kernels that make the Gaussians of a moment: what was
# learned of each kind, time and cameras, and what is made
STATIC, MOVING, LOCAL = "f2 f2 f2 f1 f2 f3", "f2 f2 f2 f1 f2 f3 f3 f2", "f2 f2 f2 f2 f2"
SIGHT, CLOUD = "d1 f2 f2 f2 f2", "f2 f2 f2 f1 f2 f1"
PIXELS = "f2 f2 f1 f1 f1 f1 b1 b1 f2 f2 b1"  # what is rendered, recorded and known before
MAPS = "f2 f1 f1 f1 f1 f1 i0 d0 d0 d0"  # what is drawn, and what lies behind it
SENSOR = "f1 f2 f1 f2 f1 i0 d0 i0 d0"  # gain, curve and lens of a frame
# what a tone mapper has learned and holds, and which of it is wanted
TONE = "f3 f1 i1 f1 f2 f2 f2 f3 f1 f2 f2 d0 i0 i0 i0 i0"
LEVELS = "i2 i2 f2"  # of a grid, and its slices of time
VECTOR = "f1 f1 f1 f1 d0 d0 "  # numbers, gradient, moments; lr, eps
ROWS = "f2 f2 f2 f2 b1 d0 d0 "  # a table, gradient, moments, marks; lr, eps
# argument types of the kernels, in order: type and number of dimensions, 0 for a number
SIGNATURES = {
    "project": "f2 f2 f2 f1 f2 f2 f2 i0 i0 d0 f2 f1 f2 s2 i1",
    "list_pairs": "s2 i1 s1 i0 i1 s1",
    "order_pairs": "i1 i1 s1 i1 s1",
    "forward": "i1 s1 f2 f2 f3 f2",
    "backward": "i1 s1 f2 f2 f3 f2 f3 f2 f2 f2",
    "project_backward": "f2 f2 f2 f1 f2 f2 i0 i0 d0 i1 f2 i0 f2 f2 f2 f1 f2",
    "cloud": f"{STATIC} {MOVING} f2 f2 f2 {LOCAL} i1 s2 s2 {SIGHT} {CLOUD}",
    "static_backward": f"f2 f2 f1 f2 f3 {SIGHT} {CLOUD} {STATIC}",
    "moving_backward": f"{MOVING} f2 f2 f2 s2 i0 {SIGHT} {CLOUD} {MOVING} f2",
    "trajectory_backward": "f2 f2 f2 d1 i0 f2 f1 f2 f2 b1 b1",
    "interpolate": f"f2 f2 {LEVELS} f2",
    "table_backward": f"f2 f2 {LEVELS} f2 b1",
    "coords_backward": f"f2 f2 f2 {LEVELS} f2",
    "adam": f"{VECTOR * layout.ADAM_VECTORS}d0 d0 d0 d0",
    "adam_rows": f"{ROWS * layout.ADAM_TABLES}d0 d0 d0 d0",
    "living": "f2 f2 d0 d0 b1",
    "photograph": f"f2 f2 f2 f2 f2 {SENSOR} f2",
    "photograph_backward": f"f2 f2 f2 f2 f2 {SENSOR} f2 f2 f2 f2 f1 f2 f2",
    "record_parts": f"f2 f1 f2 f2 f2 i0 i0 i0 {SENSOR} f2 f1",
    "record_parts_backward": f"f2 f1 f2 f2 f2 i0 i0 i0 {SENSOR} f2 f1 f2 f1 f1 f2 f2",
    "losses": f"{PIXELS} d0 d0 d0 d0 f1",
    "losses_backward": f"{PIXELS} d0 d0 d0 d0 f1 f1 f2 f1 f1 f2",
    "compose": f"{MAPS} f2 f1 f1 f2 f2 f2",
    "compose_backward": f"{MAPS} f2 f1 f1 f2 f2 f2 f2 f1 f1 f1 f1 f1",
    "tone": f"{TONE} f3 f1 f1",
    "tone_backward": f"{TONE} f3 f1 f2 f1 f1 f3 f1 f2 f2 f2",
    "local_backward": f"{LOCAL} i1 s2 i0 {SIGHT} {CLOUD} {LOCAL} b1 b1 b1 b1 b1",
}
MODULES = (
    "gaussian_kernels",
    "tile_kernels",
    "cloud_kernels",
    "cloud_gradients",
    "adam_kernels",
    "grid_kernels",
    "picture_kernels",
    "recording_kernels",
    "tone_kernels",
)  # that hold the kernels
# these may take every number for a finite one: `project` has thrown out the others
FAST = ("forward", "backward")
MACHINE_CODE = b"\x7fELF"  # its first bytes
PACKAGES = (
    "numba",
    "numba-cuda",
    "cuda-bindings",
    "nvidia-nvvm",
    "nvidia-cuda-nvcc-cu12",
    "nvidia-nvjitlink",
    "nvidia-nvjitlink-cu12",
)  # that make the machine code


def compile_kernel(name: str, capability: tuple[int, int]) -> bytes:
    """What a GPU of this compute capability runs of a kernel, or PTX where it cannot be
    linked. The entry has the kernel's name.
    """
    return link_if_possible(compile_ptx(name, capability).encode() + b"\0", capability)


def link_if_possible(ptx: bytes, capability: tuple[int, int]) -> bytes:
    """Machine code of PTX, or the PTX where the linker is missing or does not know the
    GPU. PTX ends with 0.
    """
    try:
        return link(ptx.rstrip(b"\0").decode(), capability)
    except Exception:  # of its own type, whose module is not there without nvJitLink
        return ptx


def kernel_function(name: str) -> Callable[..., None]:
    """The Python function of a kernel."""
    modules = [import_module(f"hdr_nsff.fields.kernels.cuda.{m}") for m in MODULES]
    found: Callable[..., None] = next(getattr(m, name) for m in modules if hasattr(m, name))
    return found


def compile_ptx(name: str, capability: tuple[int, int]) -> str:
    """The PTX of a kernel for GPUs of a compute capability such as (8, 9)."""
    from numba import cuda, types
    from numba.cuda import dispatcher

    kinds = {"f": types.float32, "d": types.float64, "s": types.int32, "i": types.int64}
    kinds["b"] = types.uint8

    def type_of(code: str) -> Any:
        kind, dimensions = kinds[code[0]], int(code[1])
        return types.Array(kind, dimensions, "C") if dimensions else kind

    signature = types.void(*(type_of(code) for code in SIGNATURES[name].split()))
    # numba-cuda asks the driver which GPU its device functions are for: answer for it
    device, asked = SimpleNamespace(compute_capability=capability), dispatcher.get_current_device
    dispatcher.get_current_device = lambda: device
    try:
        ptx, _ = cuda.compile(
            kernel_function(name),
            signature,
            device=False,
            fastmath=name in FAST,
            cc=capability,
            abi="numba",
        )
    finally:
        dispatcher.get_current_device = asked
    found = re.search(r"\.entry\s+(\w+)", ptx)
    assert found, f"no kernel in the PTX of {name}"
    return ptx.replace(found[1], name)


def link(ptx: str, capability: tuple[int, int]) -> bytes:
    """Machine code of PTX for one kind of GPU."""
    from cuda.bindings import nvjitlink

    architecture = "sm_{}{}".format(*capability)
    linker = nvjitlink.create(2, [f"-arch={architecture}", "-O3"])
    try:
        source = ptx.encode()
        nvjitlink.add_data(linker, nvjitlink.InputType.PTX, source, len(source), "kernels")
        nvjitlink.complete(linker)
        image = bytearray(nvjitlink.get_linked_cubin_size(linker))
        nvjitlink.get_linked_cubin(linker, image)
    finally:
        nvjitlink.destroy(linker)
    return bytes(image)


def load_kernel(name: str, capability: tuple[int, int]) -> bytes:
    """`compile_kernel`, once for each user, kind of GPU, and state of the sources.

    PTX that could not be linked is compiled once as well, but another try is made to
    link it.
    """
    stem = "{}-sm_{}{}-{}".format(name, *capability, fingerprint())
    image = read_kept(f"{stem}.cubin")
    if image is not None:
        return image
    ptx = read_kept(f"{stem}.ptx")
    image = compile_kernel(name, capability) if ptx is None else link_if_possible(ptx, capability)
    kind = "cubin" if image.startswith(MACHINE_CODE) else "ptx"
    keep(f"{stem}.{kind}", image)
    return image


def read_kept(file_name: str) -> bytes | None:
    """A file of the cache folder; None where there is none."""
    try:
        return (cache_folder() / file_name).read_bytes()
    except OSError:
        return None


def keep(file_name: str, content: bytes) -> None:
    """Write a file of the cache folder, if it can be written."""
    path = cache_folder() / file_name
    temporary = path.with_name(f"{file_name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError:  # no home to write to: they are compiled at every start
        pass


def cache_folder() -> Path:
    """Where compiled kernels are kept: beside numba's, or in the user's cache."""
    given = os.environ.get("NUMBA_CACHE_DIR")
    if given:
        return Path(given) / "hdr-nsff-cuda"
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(home) / "hdr-nsff" / "cuda"


@cache
def fingerprint() -> str:
    """Changes with the sources of the kernels and the versions of the compiler."""
    here = Path(__file__)
    sources = [here, here.with_name("device.py"), Path(layout.__file__)]
    sources += [here.with_name(f"{module}.py") for module in MODULES]
    shared = compositing, footprint, grid, moment, moment_gradients, pixel
    sources += [Path(str(m.__file__)) for m in shared]
    digest = hashlib.sha256()
    for path in sources:
        digest.update(path.read_bytes())
    digest.update(" ".join(versions(PACKAGES)).encode())
    return digest.hexdigest()[:16]


def versions(packages: Iterable[str]) -> list[str]:
    """The installed versions, "" of packages that are not installed."""
    found = []
    for package in packages:
        try:
            found.append(metadata.version(package))
        except metadata.PackageNotFoundError:
            found.append("")
    return found
