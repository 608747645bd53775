"""Corrections of the training cameras: gradients of both fields against finite
differences, the gauge, cameras that are one, resuming, what a run gives back, and
finding back a known perturbation.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from estimates import forget_movers
from presets import interrupted_at, random_field, small, trainer
from safetensors.torch import load_file
from torch import Tensor
from toy_scene import ToyScene

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.tensors import tree_map
from hdr_nsff.fields.nsff.nsff import NSFF
from hdr_nsff.fields.splat import draw
from hdr_nsff.fields.splat.config import SplatConfig
from hdr_nsff.fields.splat.rasterize import dense
from hdr_nsff.fields.splat.splat import Splat
from hdr_nsff.geometry.cameras import Camera
from hdr_nsff.scene.batch import PixelBatch, whole_frame
from hdr_nsff.scene.manifest import Manifest
from hdr_nsff.scene.scene import Scene
from hdr_nsff.training import run_folder
from hdr_nsff.training.config import TrainConfig
from hdr_nsff.training.given_poses import GivenPoses
from hdr_nsff.training.pose_corrections import (
    PoseCorrections,
    move_camera,
    typical_depth,
    visible_motion,
)
from hdr_nsff.training.presets import PRESETS
from hdr_nsff.training.run_folder import Run
from hdr_nsff.training.train import train


def edited(
    folder: Path, toy: ToyScene | None = None, **frames: dict[int, list[list[float]]]
) -> Path:
    """A toy scene in `folder` whose frames have other values, as in `c2w={3: ...}`."""
    (toy or ToyScene()).write(folder)
    manifest = Manifest.load(folder)
    for name, values in frames.items():
        for i, value in values.items():
            setattr(manifest.frames[i], name, value)
    manifest.save(folder)
    forget_movers(folder)
    return folder


def perturbation(count: int, degrees: float, share: float) -> Tensor:
    """Twists (C, 6) of so many degrees and such a share of the depth, about and along
    random axes.
    """
    g = torch.Generator().manual_seed(5)
    axes = torch.nn.functional.normalize(torch.randn(count, 2, 3, generator=g), dim=-1)
    return (axes * torch.tensor([degrees * torch.pi / 180, share])[:, None]).flatten(1)


def set_twists(corrections: PoseCorrections, twists: Tensor) -> None:
    with torch.no_grad():
        corrections.moves.copy_(torch.einsum("cij,cj->ci", corrections.to_parameters, twists))


def perturbed(scene: Scene) -> Tensor:
    """Twists of two degrees and 2 % of the depth, but for what a common similarity
    explains: nothing could find that.
    """
    corrections = PoseCorrections(scene)
    set_twists(corrections, perturbation(6, 2.0, 0.02))
    corrections.fix_gauge()
    return corrections.twists().detach()


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The toy scene with wrong cameras, with features larger than cameras are off, that
    no exposure clips.
    """
    exact, rng = ToyScene(), np.random.default_rng(0)
    coarse = [np.kron(rng.random((10, 15, 3)), np.ones((16, 16, 1))) for _ in range(2)]
    exact.textures = [0.45 * cv2.GaussianBlur(t, (0, 0), 4).astype(np.float32) for t in coarse]
    folder = exact.write(tmp_path_factory.mktemp("wrong") / "scene")
    scene = Scene.open(folder)
    cameras = [
        move_camera(f.camera, t, typical_depth(scene))
        for f, t in zip(scene.train, perturbed(scene), strict=True)
    ]
    return edited(folder, exact, c2w={i: c.c2w.tolist() for i, c in enumerate(cameras)})


def seen(field: NSFF | Splat, batch: PixelBatch, weights: dict[str, Tensor]) -> Tensor:
    """A sum over everything that a training render says, depth and flow into the
    neighbor included.
    """
    render, _ = field(batch)
    parts = {"radiance": render.radiance, "depth": render.depth, "flow": render.warps[0].flow}
    return sum((parts[k].double() * w).sum() for k, w in weights.items())  # type: ignore[return-value]


def double(values: Tensor) -> Tensor:
    return values.double() if values.is_floating_point() else values


def smooth_weights(batch: PixelBatch) -> dict[str, Tensor]:
    """Weights that vary slowly over the picture."""
    x, y = (batch.pixels / torch.tensor([60.0, 34.0])).double().unbind(-1)
    return {
        "radiance": torch.stack([(3 * x).sin(), (4 * y).cos(), x + y], -1),
        "depth": 0.3 * (3 * x + y).cos(),
        "flow": 0.01 * torch.stack([(2 * x + y).sin(), (x - 3 * y).cos()], -1),
    }


def pull(corrections: PoseCorrections, degrees: float) -> tuple[float, Tensor]:
    """What camera 1 costs when it is turned by so many degrees, and the gradient by its
    corrections.
    """
    twists = torch.zeros(6, 6)
    twists[1, 0] = degrees * torch.pi / 180
    set_twists(corrections, twists)
    corrections.zero_grad()
    cost = corrections.regularizers(1)["pose"]
    cost.backward()
    assert corrections.moves.grad is not None
    return float(cost.detach()), corrections.moves.grad[1]


def test_small_corrections_are_held_and_large_ones_let_go(toy: Scene) -> None:
    corrections = PoseCorrections(toy)
    for degrees in (0.01, 0.1, 1.0):
        assert pull(corrections, degrees)[0] == pytest.approx(
            np.log1p((degrees / 0.1) ** 2), rel=1e-3
        )
    slopes = [float(pull(corrections, degrees)[1].norm()) for degrees in (0.01, 0.1, 1.0)]
    assert (
        slopes[1] > 4 * slopes[0] and slopes[1] > 4 * slopes[2]
    )  # 2 c / (0.01 + c^2): 1.98, 10 and 1.98
    assert float(corrections.regularizers(2)["pose"].detach()) == 0.0


@pytest.mark.parametrize("what", ["radiance", "depth", "flow"])
@pytest.mark.parametrize("preset", ["splat", "grid", "paper"])
def test_a_camera_has_the_gradient_of_its_picture(
    preset: str, what: str, toy: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    # in float64 Gaussians are drawn by the plain-torch twin, here without the cut of
    # faint ones, which jumps; test_rasterize compares the kernels with it
    monkeypatch.setattr(draw, "rasterize", partial(dense, cut=False))
    field, corrections, batch = random_field(preset, toy), PoseCorrections(toy), whole_frame(toy, 2)
    if hasattr(field.config, "opaque_end"):  # a step of opacity has no gradient
        field.config = replace(field.config, opaque_end=False)
    step = 1e-4  # of the picture's width: 0.006 pixels
    if isinstance(field, NSFF):
        field.config = replace(field.config, cull=False, density_noise=0.0)
    else:
        # The wall's Gaussians share one depth: any turn would change their order.
        field.static.means.data.add_(
            0.4 * torch.randn(len(field.static), 3, generator=torch.Generator().manual_seed(1))
        )
        field, corrections, batch, step = (
            field.double(),
            corrections.double(),
            tree_map(double, batch),
            1e-7,
        )
    weights = {what: smooth_weights(batch)[what]}
    seen(field, corrections(batch), weights).backward()
    assert corrections.moves.grad is not None and corrections.zooms.grad is not None
    found = torch.cat([corrections.moves.grad[2], corrections.zooms.grad]).double()
    expected = torch.zeros(7).double()
    for i in range(7):
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                p = corrections.moves[2, i : i + 1] if i < 6 else corrections.zooms
                p.fill_(sign * step)
                values.append(seen(field, corrections(batch), weights))
                p.zero_()
        expected[i] = (values[0] - values[1]) / (2 * step)
    assert float((found - expected).norm() / expected.norm()) < 0.03, (found, expected)


def test_the_neighbors_camera_has_the_gradient_of_the_flow_into_it(toy: Scene) -> None:
    field, corrections = random_field("splat", toy), PoseCorrections(toy)
    batch = whole_frame(toy, 2)
    seen(field, corrections(batch), {"flow": smooth_weights(batch)["flow"]}).backward()
    rows = corrections.moves.grad.abs().amax(1)  # type: ignore[union-attr]
    assert (
        float(rows[2]) > 0 and float(rows[[1, 3]].max()) > 0 and float(rows[[0, 4, 5]].max()) == 0
    )


def test_a_common_similarity_is_taken_out_of_the_corrections(toy: Scene) -> None:
    corrections = PoseCorrections(toy)
    own = perturbation(6, 0.5, 0.01)
    set_twists(corrections, own)
    corrections.fix_gauge()
    kept = corrections.twists().detach().clone()
    corrections.fix_gauge()
    torch.testing.assert_close(corrections.twists(), kept)
    turn, shift, scale = (
        torch.tensor([0.004, -0.003, 0.002]),
        torch.tensor([0.01, 0.02, -0.01]),
        1.003,
    )
    centers = torch.stack([f.camera.c2w[:, 3] for f in toy.train]) / corrections.unit
    common = torch.cat(
        [
            turn.expand(6, 3),
            shift + (scale - 1) * centers + torch.linalg.cross(turn.expand(6, 3), centers),
        ],
        1,
    )
    set_twists(corrections, kept + common)
    assert float((corrections.twists().detach() - kept).abs().max()) > 0.01
    corrections.fix_gauge()
    torch.testing.assert_close(corrections.twists(), kept, atol=1e-6, rtol=1e-4)


def test_a_parameter_is_the_rms_motion_of_the_picture(toy: Scene) -> None:
    corrections, f = PoseCorrections(toy), toy.train[2]
    assert f.disparity is not None
    rays = f.camera.rays(f.camera.pixel_grid())
    points = rays.origins + rays.directions / f.disparity.reshape(-1, 1)
    sizes = []
    for i in range(6):
        with torch.no_grad():
            corrections.moves.zero_()
            corrections.moves[2, i] = 1e-3
            shifted = corrections.camera(f.camera, *corrections.frames[2]).project(points)[0]
        sizes.append(
            float((shifted - f.camera.pixel_grid()).square().sum(-1).mean().sqrt()) / 60 / 1e-3
        )
    assert (
        max(sizes) < 1.05 and sorted(sizes)[-2] > 0.6
    )  # damped: the least visible ones move it less


def refining(scene: Path, out: Path, preset: str = "tiny", steps: int = 24) -> TrainConfig:
    return replace(small(preset, scene, out, steps), refine_poses=True, pose_lr=2e-3, seed=3)


def test_frames_of_one_camera_keep_one_pose(tmp_path: Path) -> None:
    same = ToyScene().write(tmp_path / "exact")
    pose = Manifest.load(same).frames[1].c2w
    assert pose is not None
    run = Run.open(train(refining(edited(tmp_path / "scene", c2w={4: pose}), tmp_path / "run")))
    cameras, before = [f.camera for f in run.scene.train], Scene.open(tmp_path / "scene").train
    assert torch.equal(cameras[1].c2w, cameras[4].c2w) and torch.equal(cameras[1].K, cameras[4].K)
    assert all(
        float((c.c2w - f.camera.c2w).abs().max()) > 1e-5
        for c, f in zip(cameras, before, strict=True)
    )


def test_without_corrections_no_camera_has_a_gradient_and_no_state_is_saved(
    toy: Scene, toy_folder: Path, tmp_path: Path
) -> None:
    assert not any(c.refine_poses for c in PRESETS.values())
    t = trainer(small("splat", toy_folder, tmp_path / "run"), toy)
    asked: list[Camera] = []
    t.field.register_forward_pre_hook(lambda module, inputs: asked.append(inputs[0].camera))
    t.step()
    assert (
        type(t.poses) is GivenPoses
        and not asked[0].c2w.requires_grad
        and not asked[0].K.requires_grad
    )
    assert any(asked[0] is f.camera for f in t.scene.train)
    t.save()
    assert not any(
        k.startswith("poses.") for k in load_file(max((tmp_path / "run/checkpoints").iterdir()))
    )


@pytest.mark.parametrize("preset", ["splat", "grid"])
def test_a_stopped_run_resumes_to_the_unbroken_ones_corrections(
    preset: str, toy_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run_folder, "write_preview", lambda *_: None)
    straight = train(refining(toy_folder, tmp_path / "straight", preset))
    settings = replace(refining(toy_folder, tmp_path / "run", preset), checkpoint_seconds=0.0)
    for stop in (1, 13):  # before and after cameras start to move
        interrupted_at(stop, settings, monkeypatch)
    a, b = (load_file(max((run / "checkpoints").glob("*"))) for run in (straight, train(settings)))
    assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
    assert float(a["poses.moves"].abs().max()) > 1e-4 and float(a["poses.zooms"].abs().max()) > 0


def test_a_run_gives_back_the_cameras_it_found(tmp_path: Path) -> None:
    folder = edited(tmp_path / "scene", split={3: "test"})
    run, before = Run.open(train(refining(folder, tmp_path / "run"))), Scene.open(folder)
    entries = run.scene.manifest.frames
    for f in run.scene.train + run.scene.test:
        assert torch.equal(torch.tensor(entries[f.index].c2w), f.camera.c2w) and torch.equal(
            torch.tensor(entries[f.index].K), f.camera.K
        )
    assert not any(
        torch.equal(f.camera.c2w, g.camera.c2w)
        for f, g in zip(run.scene.train, before.train, strict=True)
    )
    held_out = run.scene.test[0].camera
    assert torch.equal(held_out.c2w, before.test[0].camera.c2w)  # no training picture has seen it
    assert torch.equal(held_out.K, run.scene.train[0].camera.K) and not torch.equal(
        held_out.K, before.test[0].camera.K
    )
    rotation = run.scene.train[0].camera.c2w[:, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3), atol=1e-5, rtol=0)


def test_a_camera_at_rest_is_refused_and_a_turning_one_only_turns(toy: Scene) -> None:
    still, turning = (
        replace(toy, manifest=toy.manifest.model_copy(update={"parallax": p}))
        for p in ("none", "rotation")
    )
    with pytest.raises(InputError, match="stands still"):
        PoseCorrections(still)
    corrections = PoseCorrections(turning)
    with torch.no_grad():
        corrections.moves.normal_(generator=torch.Generator().manual_seed(0))
    corrections.fix_gauge()
    twists = corrections.twists().detach()
    assert float(twists[:, 3:].abs().max()) == 0 and float(twists[:, :3].abs().max()) > 0.1
    assert float(twists[:, :3].mean(0).abs().max()) < 1e-5


def test_a_known_perturbation_is_recovered(wrong: Path, toy: Scene, tmp_path: Path) -> None:
    field = SplatConfig(static=1200, moving=300, bases=2)
    settings = replace(refining(wrong, tmp_path / "run", "splat", 240), field=field, pose_lr=1e-3)
    state = load_file(max((train(settings) / "checkpoints").glob("*")))
    learned, judge = PoseCorrections(Scene.open(wrong)), PoseCorrections(toy)
    learned.load_state_dict(
        {k.removeprefix("poses."): v for k, v in state.items() if k.startswith("poses.")}
    )

    def pixels(twists: Tensor) -> float:
        """Root mean square motion of the pictures by twists (6, 6), but for what a
        common similarity explains.
        """
        set_twists(judge, twists)
        judge.fix_gauge()
        left = judge.twists().detach().double()
        return 60 * float(torch.einsum("ti,tij,tj->t", left, metric, left).mean().sqrt())

    metric = torch.stack([visible_motion(f, toy, judge.unit) for f in toy.train])
    before, after = pixels(perturbed(toy)), pixels(perturbed(toy) + learned.twists().detach())
    assert before > 1.0 and after < 0.4 * before, (before, after)
