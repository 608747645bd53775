"""The CUDA rasterizer on a CPU, by the simulator of numba-cuda: against plain torch in
float64, and against the CPU's kernels. `test_rasterize_cuda.py` runs these tests in a
process with NUMBA_ENABLE_CUDASIM=1, which numba reads when it is imported.
"""

import ctypes
import math
import struct
import threading
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from test_rasterize import NAMES, ahead, at_depths, camera, compare, drawn, facing, scene
from torch import Tensor

from hdr_nsff.fields.kernels import footprint, grid
from hdr_nsff.fields.kernels.cuda import launch as launching
from hdr_nsff.fields.kernels.cuda.compile import SIGNATURES
from hdr_nsff.fields.kernels.cuda.launch import Driver, launch, pack
from hdr_nsff.fields.kernels.cuda.layout import ADAM_TABLES
from hdr_nsff.fields.splat import rasterize_cuda
from hdr_nsff.fields.splat.rasterize import (
    Maps,
    rasterize,
    world_to_camera_and_focal,
)
from hdr_nsff.fields.splat.try_out import fault_of
from hdr_nsff.geometry.cameras import Camera

# of the largest number, between kernels that add up in other orders, and where nothing
# behind MIN_TRANSMITTANCE is drawn: by pixel here, by tile on the CPU
ROUNDING, BEHIND = 1e-4, 1e-3


def simulated(*arguments: Any) -> Maps:
    """The CUDA rasterizer, called like `rasterize`."""
    *gaussians, view = arguments
    size = view.width, view.height
    w2c, K = world_to_camera_and_focal(view).float(), view.K.detach().float()
    return Maps(*rasterize_cuda.composite(*gaussians, w2c, K, size))


def compare_both(
    gaussians: list[Tensor], view: Camera, gradients: float = 1e-3, off: float = ROUNDING
) -> Tensor:
    """The maps (H, W, D + 2), the same by plain torch and by the CPU's kernels."""
    shape = (view.height, view.width, gaussians[4].shape[1] + 2)
    generator = torch.Generator().manual_seed(5)
    weight = torch.randn(shape, generator=generator, dtype=torch.float64)
    ours, theirs = (drawn(twin, gaussians, view, weight) for twin in (simulated, rasterize))
    assert float((ours[0] - theirs[0]).abs().max()) <= off
    for name, a, b in zip(NAMES, ours[1], theirs[1], strict=True):
        if b.numel():
            found, largest = float((a - b).abs().max()), float(b.abs().max())
            assert found <= off * largest + 1e-6, f"gradient of {name} is off by {found:.3g}"
    return compare(gaussians, view, gradients, simulated)


@pytest.mark.parametrize(
    ("seed", "channels", "size", "count"),
    [(0, 4, (24, 20), 15), (1, 1, (16, 8), 30), (2, 17, (16, 16), 12), (3, 7, (1, 1), 9),
     (4, 7, (32, 32), 9)],
)  # fmt: skip
def test_random_scenes(seed: int, channels: int, size: tuple[int, int], count: int) -> None:
    view = camera(*size)
    seen = compare_both(scene(seed, view, count=count, channels=channels), view)
    assert float(seen[..., -1].max()) > 0.4


def test_gaussians_behind_the_camera() -> None:
    view = camera(16, 16)
    seen = compare_both(at_depths(view, (-2.0, 0.0), 1.0), view)
    assert float(seen.abs().max()) == 0  # and so is the largest gradient


def test_nothing_nearer_than_asked_for_is_drawn() -> None:
    view = camera(16, 16)
    gaussians = [t.float() for t in at_depths(view, (0.5, 1.5), 1.0, 0.1)]
    w2c, K = world_to_camera_and_focal(view).float(), view.K.float()
    ours = rasterize_cuda.composite(*gaussians, w2c, K, (16, 16), 1.0)
    for seen, expected in zip(ours, rasterize(*gaussians, view, 1.0), strict=True):
        torch.testing.assert_close(seen, expected, rtol=1e-4, atol=1e-4)
    every = rasterize(*gaussians, view)
    assert float((ours[2] - every.alpha).abs().max()) > 0.1


def test_gaussians_across_the_near_plane() -> None:
    view = camera(16, 16)
    gaussians = at_depths(view, (0.0, 3 * footprint.NEAREST), 1.0, 0.01)
    compare_both([t[:20] for t in gaussians], view, gradients=5e-3)


def test_gaussians_outside_of_the_picture() -> None:
    view = camera(16, 16)
    compare_both([t[:20] for t in at_depths(view, (1.0, 2.0), 3.0)], view)


def test_no_gaussians() -> None:
    view = camera(17, 16)
    assert float(compare_both(scene(0, view, count=0), view).abs().max()) == 0


@pytest.mark.parametrize("size", [1e-6, 1000.0])
def test_dust_and_giants(size: float) -> None:
    view = camera(20, 16)
    gaussians = scene(5, view, count=20)
    gaussians[2] = (gaussians[2] * size).float().double()
    gaussians[3] = (gaussians[3] * 0.3).float().double()  # light gets through all of them
    assert float(compare_both(gaussians, view)[..., -1].max()) > 0.1


def test_needles() -> None:
    view = camera(20, 16)
    gaussians = scene(5, view, count=20)
    gaussians[2] = torch.tensor([3.0, 1e-5, 1e-5]).double().expand(20, 3)
    compare_both(gaussians, view)


def test_more_gaussians_than_a_batch_and_an_opaque_stack() -> None:
    view = camera(12, 16)
    gaussians = scene(7, view, count=270)
    gaussians[2] = gaussians[2] * 0.02
    gaussians[3][:] = 0.05
    front = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    compare_both(gaussians, view)
    gaussians[0][:20] = ahead(view, front).float().double()
    gaussians[2][:20], gaussians[3][:20] = 10.0, 1.0
    seen = compare_both(gaussians, view, off=BEHIND)
    assert float(seen[..., -1].min()) > 0.999


@pytest.mark.parametrize(
    ("part", "value"),
    [*((part, math.nan) for part in range(4)), (2, math.inf), (3, math.inf)],
)
def test_a_gaussian_that_is_not_finite_is_not_drawn_and_harms_no_other(
    part: int, value: float
) -> None:
    view = camera(16, 16)
    gaussians = scene(0, view, count=8)
    rest = [torch.cat([t[:7], t[8:]]) for t in gaussians]
    gaussians[part].view(8, -1)[7, -1] = value
    weight = torch.ones(16, 16, 6, dtype=torch.float64)
    seen, gradients = drawn(simulated, gaussians, view, weight)
    expected, theirs = drawn(simulated, rest, view, weight)
    assert torch.equal(seen, expected)
    for a, b in zip(gradients[:5], theirs[:5], strict=True):
        assert float(a[7].abs().max()) == 0
        torch.testing.assert_close(torch.cat([a[:7], a[8:]]), b)


def test_of_coincident_gaussians_the_first_is_in_front() -> None:
    gaussians, view = facing(0.6, 0.5, z=(2.0, 2.0))
    seen = float(simulated(*gaussians, view).features[3, 4, 0])
    assert seen == pytest.approx(0.6 * 1 + 0.4 * 0.5 * 2)


def test_one_gaussian_is_drawn_at_the_door() -> None:
    assert fault_of(rasterize_cuda.composite, "cpu") is None


def test_no_gradient_is_made_for_a_pose_that_wants_none() -> None:
    view = camera(16, 16)
    leaves = [t.float().requires_grad_() for t in scene(0, view, count=5)]
    simulated(*leaves, view).alpha.sum().backward()
    assert view.c2w.grad is None and float(leaves[0].grad.abs().max()) > 0


class Contexts:
    """A libcuda with a context for each device."""

    def __init__(self) -> None:
        self.retained: list[int] = []
        self.current = threading.local()

    def cuInit(self, flags: int) -> int:  # noqa: N802
        return flags

    def cuDeviceGet(self, handle: Any, device: int) -> int:  # noqa: N802
        handle._obj.value = 10 + device
        return 0

    def cuDevicePrimaryCtxRetain(self, context: Any, handle: Any) -> int:  # noqa: N802
        self.retained.append(handle.value)
        context._obj.value = 100 + handle.value
        return 0

    def cuCtxSetCurrent(self, context: Any) -> int:  # noqa: N802
        self.current.context = context.value
        return 0


class SimulatedDriver(Contexts):
    """A libcuda that finds a kernel's arguments as a GPU would, and simulates it."""

    def __init__(self, name: str) -> None:
        super().__init__()
        self.name = name

    def cuLaunchKernel(self, function: Any, *values: Any) -> int:  # noqa: N802
        *blocks, shared, _, _, extra = values
        assert (extra[0], extra[2], extra[4] or 0, shared) == (1, 2, 0, 0)
        size = ctypes.c_size_t.from_address(extra[3]).value
        numbers = list((ctypes.c_int64 * (size // 8)).from_address(extra[1]))
        kinds = {"f": np.float32, "d": np.float64, "s": np.int32, "i": np.int64}
        arguments: list[Any] = []
        for code in SIGNATURES[self.name].split():
            dimensions = int(code[1])
            if not dimensions:
                number = struct.pack("q", numbers.pop(0))
                arguments += struct.unpack("d" if code[0] == "d" else "q", number)
                continue
            meminfo, parent, _, item, address, *shape = numbers[: 5 + dimensions]
            strides = numbers[5 + dimensions : 5 + 2 * dimensions]
            del numbers[: 5 + 2 * dimensions]
            kind = np.dtype(kinds[code[0]])
            assert (meminfo, parent, item) == (0, 0, kind.itemsize)
            room = (ctypes.c_char * (math.prod(shape) * item)).from_address(address)
            arguments.append(torch.from_numpy(np.ndarray(shape, kind, room, 0, strides)))
        assert not numbers and blocks[2:] == [1, blocks[3], 1, 1]
        launch(self.name, (blocks[0], blocks[1]), blocks[3], *arguments)
        return 0


def test_the_driver_gets_the_arguments_as_a_kernel_reads_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    view = camera(16, 16)
    weight = torch.ones(16, 16, 6, dtype=torch.float64)
    expected = drawn(simulated, scene(0, view, count=6), view, weight)

    def by_driver(name: str, grid: tuple[int, int], threads: int, *arguments: Any) -> None:
        driver = Driver(SimulatedDriver(name))
        driver.launch(0, ctypes.c_void_p(1), grid, threads, 0, pack(*arguments))

    monkeypatch.setattr(rasterize_cuda, "launch", by_driver)
    found = drawn(simulated, scene(0, view, count=6), view, weight)
    for a, b in zip((found[0], *found[1]), (expected[0], *expected[1]), strict=True):
        assert torch.equal(a, b)


def test_a_failure_of_the_driver_is_named() -> None:
    class Broken(Contexts):
        def cuLaunchKernel(self, *values: Any) -> int:  # noqa: N802
            return 700

        def cuGetErrorString(self, code: int, text: Any) -> int:  # noqa: N802
            text._obj.value = b"an illegal memory access was encountered"
            return 0

    with pytest.raises(RuntimeError, match="cuLaunchKernel failed: an illegal memory"):
        Driver(Broken()).launch(0, ctypes.c_void_p(1), (1, 1), 1, 0, b"")


def test_a_kernel_is_launched_in_the_context_of_its_device_from_any_thread() -> None:
    class WithContext(Contexts):
        launches: ClassVar[list[int | None]] = []

        def cuLaunchKernel(self, *values: Any) -> int:  # noqa: N802
            self.launches.append(getattr(self.current, "context", None))
            return 0

    library = WithContext()
    driver = Driver(library)

    def start(device: int) -> None:
        arguments = device, ctypes.c_void_p(1), (1, 1), 1, 0, b""
        thread = threading.Thread(target=driver.launch, args=arguments)
        thread.start()
        thread.join()

    for device in (0, 1, 0, 1):
        start(device)
    assert library.launches == [110, 111, 110, 111] and library.retained == [10, 11]


ROWS = (torch.zeros(3, 4), torch.zeros(3, 4), 0.5, 0.1, torch.zeros(3, dtype=torch.uint8))


@pytest.mark.parametrize(
    ("position", "wrong", "found"),
    [
        (1, torch.zeros(3, 4, device="meta"), r"float32 \(3, 4\) on meta"),
        (1, torch.zeros(3, 4, dtype=torch.float64), r"float64 \(3, 4\) on cpu"),
        (1, torch.zeros(12), r"float32 \(12,\) on cpu"),
        (1, 2.0, "2.0"),
        (2, 1, "1"),
        (2, torch.zeros(()), r"float32 \(\) on cpu"),
    ],
)
def test_an_argument_that_a_kernel_does_not_take_is_refused(
    position: int, wrong: Tensor | float, found: str
) -> None:
    given = list(ROWS)
    launch("living", (1, 1), 3, *given)
    given[position] = wrong
    with pytest.raises(TypeError, match=f"living: argument {position} is .*{found}, and has to"):
        launch("living", (1, 1), 3, *given)


def test_tensors_of_the_cpu_are_refused_without_the_simulator(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from numba.core import config

    monkeypatch.setattr(config, "ENABLE_CUDASIM", 0)
    with pytest.raises(RuntimeError, match="NUMBA_ENABLE_CUDASIM=1"):
        launching.simulate("project", (1, 1), 1)


def test_adam_moves_the_rows_that_it_moves_on_the_cpu() -> None:
    generator = torch.Generator().manual_seed(0)
    shared = 0.9, 0.99, 0.19, 0.0199
    given, expected = [], []
    for n in range(ADAM_TABLES):
        tables = [torch.rand(9 * (n % 3), 4, generator=generator) for _ in range(4)]
        marks = torch.tensor([1, 0, 1, 0, 1, 1, 0, 0, 1], dtype=torch.uint8).repeat(n % 3)
        tables[1][marks == 0] = 0.0
        tables[1][:1] = 0.0  # a mark without a gradient moves on
        lr, eps = 0.1 * (n + 1), 10.0**-n
        twins = [t.clone() for t in (*tables, marks)]
        grid.adam_rows(*(t.numpy() for t in twins), lr, *shared[:2], eps, *shared[2:])
        given += [*tables, marks, lr, eps]
        expected.append(twins)
    launch("adam_rows", (2, 1), 16, *given, *shared)
    for n, twins in enumerate(expected):
        for i in (0, 2, 3, 4):
            torch.testing.assert_close(given[7 * n + i], twins[i])
