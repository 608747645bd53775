"""CUDA kernels without a GPU: every test of `simulated_cuda.py` in one process with
numba-cuda's simulator, and every kernel compiled for four kinds of GPU.
"""

import re
from functools import cache
from importlib import metadata
from pathlib import Path

import pytest
from simulator import assert_passed, names_in

from hdr_nsff.fields.kernels.cuda import compile as compiling
from hdr_nsff.fields.kernels.cuda.compile import SIGNATURES, compile_ptx, link, load_kernel
from hdr_nsff.fields.splat import rasterize_cuda

SIMULATED = Path(__file__).with_name("simulated_cuda.py")
CAPABILITIES = [(7, 5), (8, 0), (9, 0), (12, 0)]  # Turing, Ampere, Hopper, Blackwell


@pytest.mark.parametrize("name", names_in(SIMULATED))
def test_simulated(name: str) -> None:
    assert_passed(SIMULATED, name, SIMULATED)


ptx_of = cache(compile_ptx)
needs_compiler = pytest.mark.skipif(
    not any(d.name == "numba-cuda" for d in metadata.distributions()),
    reason="THE CUDA KERNELS ARE NOT COMPILED: numba-cuda is missing (extra gpu)",
)


@needs_compiler
@pytest.mark.parametrize("capability", CAPABILITIES)
@pytest.mark.parametrize("name", list(SIGNATURES))
def test_a_kernel_becomes_machine_code(name: str, capability: tuple[int, int]) -> None:
    ptx = ptx_of(name, capability)
    assert "\n.target sm_{}{}".format(*capability) in ptx
    assert f".visible .entry {name}(" in ptx
    assert not re.search(r"(ld|st)\.local", ptx)  # everything is in registers
    assert link(ptx, capability)[:4] == b"\x7fELF"


@needs_compiler
@pytest.mark.parametrize("name", ["project", "project_backward"])
def test_a_gaussian_is_projected_in_float64(name: str) -> None:
    ptx = ptx_of(name, (8, 0))
    assert len(re.findall(r"\bfma\.rn\.f64", ptx)) >= 9  # of the camera point alone
    single = re.findall(r"\b(?:fma|mul|add|sub|div|sqrt)[\w.]*\.f32", ptx)
    # the opacity's gradient is a quotient of two stored numbers
    assert single == ["div.rn.f32"] * (name == "project_backward")


@needs_compiler
@pytest.mark.parametrize("name", list(SIGNATURES))
def test_a_kernel_takes_eight_byte_numbers_as_many_as_are_packed(name: str) -> None:
    ptx = ptx_of(name, (8, 0))
    parameters = ptx.partition(f".entry {name}(")[2].partition(")")[0]
    dimensions = [int(code[1]) for code in SIGNATURES[name].split()]
    expected = sum(5 + 2 * d if d else 1 for d in dimensions)
    kinds = re.findall(r"\.param \.(\w+)", parameters)
    assert len(kinds) == expected and set(kinds) <= {"u64", "f64"}
    assert kinds.count("f64") == SIGNATURES[name].split().count("d0")


@needs_compiler
def test_a_gpu_that_the_linker_does_not_know_gets_ptx(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(ptx: str, capability: tuple[int, int]) -> bytes:
        raise RuntimeError("unknown architecture")

    monkeypatch.setattr(compiling, "link", unknown)
    image = compiling.compile_kernel("list_pairs", (9, 0))
    assert b".entry list_pairs" in image and image.endswith(b"\0")


def test_a_kernel_is_compiled_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled: list[str] = []
    image = b"\x7fELF machine code"

    def compile_kernel(name: str, capability: tuple[int, int]) -> bytes:
        compiled.append(name)
        return image

    monkeypatch.setattr(compiling, "compile_kernel", compile_kernel)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    for capability in ((8, 0), (8, 0), (9, 0)):
        assert load_kernel("forward", capability) == image
    assert compiled == ["forward", "forward"]
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "hdr-nsff-cuda" / "file"))
    next((tmp_path / "hdr-nsff-cuda").iterdir()).rename(tmp_path / "hdr-nsff-cuda" / "file")
    assert load_kernel("forward", (8, 0)) == image  # where nothing can be written


def test_ptx_is_linked_by_a_linker_that_is_there_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled: list[str] = []

    def compile_ptx(name: str, capability: tuple[int, int]) -> str:
        compiled.append(name)
        return "PTX"

    def missing(ptx: str, capability: tuple[int, int]) -> bytes:
        raise ImportError("no nvJitLink")

    monkeypatch.setattr(compiling, "compile_ptx", compile_ptx)
    monkeypatch.setattr(compiling, "link", missing)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    assert [load_kernel("forward", (8, 0)) for _ in range(2)] == 2 * [b"PTX\0"]
    linked = []

    def link(ptx: str, capability: tuple[int, int]) -> bytes:
        linked.append((ptx, capability))
        return b"\x7fELF"

    monkeypatch.setattr(compiling, "link", link)
    assert [load_kernel("forward", (8, 0)) for _ in range(2)] == 2 * [b"\x7fELF"]
    assert compiled == ["forward"] and linked == [("PTX", (8, 0))]


@pytest.mark.parametrize("package", ["nvidia-nvjitlink", "nvidia-nvjitlink-cu12"])
def test_another_linker_compiles_anew(package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    found = set()
    for version in ("", "12.8", "12.9"):
        installed = {package: version}
        monkeypatch.setattr(
            compiling, "versions", lambda names, of=installed: [of.get(n, "1.0") for n in names]
        )
        found.add(compiling.fingerprint.__wrapped__())
    assert len(found) == 3


@pytest.mark.parametrize(("cuda", "extra"), [("12.8", "gpu12"), ("13.0", "gpu"), (None, "gpu")])
def test_the_extra_fits_the_cuda_version_of_torch(
    cuda: str | None, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.version.cuda", cuda)
    assert rasterize_cuda.install_command() == f"pip install 'hdr-nsff[{extra}]'"


def test_a_missing_compiler_is_a_sentence_with_the_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> str:
        raise metadata.PackageNotFoundError(name)

    monkeypatch.setattr(metadata, "version", missing)
    rasterize_cuda.fault.cache_clear()
    assert "numba-cuda, which is not installed: pip install" in str(rasterize_cuda.fault("cpu"))
    rasterize_cuda.fault.cache_clear()


def test_a_kernel_that_cannot_be_launched_is_a_sentence_with_the_fix(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(*arguments: object) -> None:
        raise RuntimeError("cuModuleLoadData failed: unsupported toolchain\nand more")

    monkeypatch.setattr(metadata, "version", lambda name: "0.30.4")
    monkeypatch.setattr(rasterize_cuda, "launch", broken)
    rasterize_cuda.fault.cache_clear()
    reason = str(rasterize_cuda.fault("cpu"))
    rasterize_cuda.fault.cache_clear()
    assert "numba-cuda 0.30.4 cannot draw" in reason and "unsupported toolchain)" in reason
    assert "pip install 'hdr-nsff[gpu]', or update NVIDIA's driver" in reason
