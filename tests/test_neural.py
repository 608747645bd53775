"""`prepare` with tiny networks, on a clip whose camera, flow and mover are known."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from masks_of_discs import HEIGHT, WIDTH, disc
from tiny_networks import tiny_depth_anything, tiny_sam2

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import read_npy, write_npy, write_text
from hdr_nsff.prepare.prepare import PrepareConfig, prepare
from hdr_nsff.prepare.steps import neural
from hdr_nsff.prepare.steps.neural import weights_of
from hdr_nsff.priors.flow.semantic import SemanticConfig
from hdr_nsff.priors.weights import KNOWN
from hdr_nsff.scene.manifest import Manifest

COUNT, H, W, FOCAL, SIDE = 9, 64, 96, 80.0, 20


def textured(seed: int, height: int, width: int) -> np.ndarray:
    return np.kron(
        np.random.default_rng(seed).uniform(0.1, 0.9, (height // 2, width // 2, 3)),
        np.ones((2, 2, 1)),
    )


def square(t: int) -> tuple[slice, slice]:
    """Where the mover is: 3 pixels to the right per frame."""
    return slice(24, 24 + SIDE), slice(10 + 3 * t, 10 + 3 * t + SIDE)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> PrepareConfig:
    """A wall at z = 2 that moves by -2 pixels a frame (the camera slides), a square
    before it, exact poses, flow and depth.
    """
    root = tmp_path_factory.mktemp("clip")
    wall, mover, rows = textured(0, H, W + 2 * COUNT), textured(1, SIDE, SIDE), []
    for t in range(COUNT):
        rgb = wall[:, 2 * t : 2 * t + W].copy()
        rgb[square(t)] = mover
        write_png(root / f"clip/{t:03d}.png", rgb)
        write_npy(root / f"depth/{t:05d}.npy", np.full((H, W), 2, np.float32))
        rows.append(
            [
                *np.array([[0, 1, 0, 0.05 * t, H], [1, 0, 0, 0, W], [0, 0, -1, 0, FOCAL]]).ravel(),
                1.0,
                4.0,
            ]
        )
        for other in range(max(t - 2, 0), min(t + 3, COUNT)):
            flow = np.full((H, W, 2), [2.0 * (t - other), 0], np.float32)
            flow[square(t)] = [3.0 * (other - t), 0]
            write_npy(root / f"flow/{t:05d}_{other:05d}.npy", flow)
    write_npy(root / "poses_bounds.npy", np.array(rows))
    given = {"poses": root / "poses_bounds.npy", "flow": root / "flow", "depth": root / "depth"}
    return PrepareConfig(root / "clip", root / "scene", hold_out=4, ev="0", **given)


@pytest.fixture(scope="module")
def motion(clip) -> Path:
    """The scene with masks by geometry alone."""
    return prepare(clip)


def masks(scene: Path) -> np.ndarray:
    return np.stack([read_mask(scene / str(f.mask)) for f in Manifest.load(scene).frames])


def test_the_motion_mask_finds_the_square(motion):
    for t, mask in enumerate(masks(motion)):
        assert mask[square(t)].mean() > 0.8 and mask.mean() < 0.3


def test_sam2_gets_points_of_the_square_and_its_wrong_outlines_are_rejected(
    clip, motion, tmp_path, capsys
):
    before = masks(motion)
    scene = shutil.copytree(motion, tmp_path / "scene")
    prepare(replace(clip, out=scene, masks="sam2", mask_weights=str(tiny_sam2(tmp_path / "sam2"))))
    m = Manifest.load(scene)
    assert (
        m.steps["masks"].provenance == "estimated" and m.steps["masks"].details["source"] == "sam2"
    )
    assert m.steps["poses"].details["attempt"] == 1  # whoever outlines the masks, the poses stay
    prompts = json.loads((scene / "masks/prompts.json").read_text())
    train = {f.index for f in m.frames if f.split == "train"}
    assert len(train) < COUNT and {p["frame"] for p in prompts["points"]} <= train
    for p in prompts["points"]:
        inside = np.zeros((H, W), bool)
        inside[square(p["frame"])] = True
        assert inside[int(p["y"]), int(p["x"])] == bool(p["label"])
    assert "the motion mask is kept" in capsys.readouterr().err  # random weights outline anything
    for t in train:
        assert (masks(scene)[t] == before[t]).mean() > 0.98  # equal but for specks


def test_a_points_file_is_for_sam2_alone(clip, tmp_path):
    (tmp_path / "points.json").write_text("{}")
    with pytest.raises(InputError, match="--mask sam2"):
        prepare(replace(clip, out=tmp_path / "scene", mask_points=tmp_path / "points.json"))
    assert not (tmp_path / "scene").exists()


def test_a_new_object_of_one_camera_numbers_none_of_another_anew(tmp_path, monkeypatch):
    """Both cameras see one mover in five frames: objects 1 and 2."""
    slid = np.stack([disc(30 + 4 * t, 25, 11) for t in range(5)])
    points = [
        {"frame": 0, "object": 3, "x": 100.0, "y": 60.0, "label": 1},
        {"frame": 5, "object": 2, "x": 40.0, "y": 50.0, "label": 0},
    ]
    (tmp_path / "points.json").write_text(json.dumps({"points": points}))
    work = SimpleNamespace(
        config=PrepareConfig(tmp_path, tmp_path, mask_points=tmp_path / "points.json"),
        manifest=SimpleNamespace(
            frames=[SimpleNamespace(split="train")] * 10, height=HEIGHT, width=WIDTH
        ),
        equalized=[np.zeros((10, HEIGHT, WIDTH, 3), np.float32)],
        camera_frames=lambda: [list(range(5)), list(range(5, 10))],
        folder=tmp_path,
    )
    prompted = []
    monkeypatch.setattr(neural, "load_network", lambda *which: None)
    monkeypatch.setattr(
        neural, "sam2_mask", lambda network, video, objects, note: prompted.append(objects) or False
    )
    neural.sam2_masks(work, np.concatenate([slid, slid]))  # type: ignore[arg-type]
    assert [[o.number for o in objects] for objects in prompted] == [[1, 3], [2]]


def test_points_in_held_out_frames_are_refused(clip, motion, tmp_path):
    scene = shutil.copytree(motion, tmp_path / "scene")
    held_out = next(f.index for f in Manifest.load(scene).frames if f.split == "test")
    point = {"frame": held_out, "object": 1, "x": 30.0, "y": 30.0, "label": 1}
    (tmp_path / "points.json").write_text(json.dumps({"points": [point]}))
    weights = str(tiny_sam2(tmp_path / "sam2"))
    with pytest.raises(InputError, match=f"frame {held_out} is held out"):
        prepare(
            replace(
                clip,
                out=scene,
                masks="sam2",
                mask_weights=weights,
                mask_points=tmp_path / "points.json",
            )
        )


@pytest.mark.parametrize("kind", ["relative", "metric"])
def test_depth_anything_is_aligned_to_points_and_its_kind_is_recorded(kind, clip, motion, tmp_path):
    scene = shutil.copytree(motion, tmp_path / "scene")
    weights = str(tiny_depth_anything(tmp_path / "network", kind))
    prepare(replace(clip, out=scene, depth="depth-anything", depth_weights=weights))
    m = Manifest.load(scene)
    step = m.steps["depth"]
    assert (step.details["source"], step.details["kind"], step.details["weights"]) == (
        "depth-anything",
        kind,
        weights,
    )
    assert m.depth_kind == "scene" and step.provenance == "estimated"
    for f in (f for f in m.frames if f.split == "train"):
        wall = ~read_mask(scene / str(f.mask))
        assert np.median(read_npy(scene / str(f.disparity))[wall]) == pytest.approx(
            0.5, rel=0.1
        )  # z = 2, whatever the network predicts


def test_missing_weights_are_refused_before_anything_is_written(clip, tmp_path, monkeypatch):
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path / "cache"))
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    for chosen, words in (
        ({"masks": "sam2"}, "sam2.1-hiera-tiny"),
        ({"depth": "depth-anything"}, "Depth-Anything-V2-Small"),
    ):
        with pytest.raises(InputError, match=words):
            prepare(replace(clip, out=tmp_path / "scene", **chosen))
    assert not (tmp_path / "scene").exists()


def test_weights_of_another_network_are_refused_before_anything_is_written(clip, tmp_path):
    other = str(tiny_depth_anything(tmp_path / "network", "metric"))
    for weights, words in ((other, "weights of 'depth_anything'"), ("xfeat", "no Sam2VideoModel")):
        with pytest.raises(InputError, match=words):
            prepare(replace(clip, out=tmp_path / "scene", masks="sam2", mask_weights=weights))
    assert not (tmp_path / "scene").exists()


@pytest.mark.parametrize("chosen", [{}, {"poses": None, "tripod": True}])
def test_a_matcher_is_refused_where_no_keypoints_are_matched(chosen, clip, tmp_path):
    with pytest.raises(InputError, match="no keypoints are matched with --"):
        prepare(replace(clip, out=tmp_path / "scene", matcher="disk", **chosen))


def test_weights_that_no_chosen_network_reads_are_refused(clip, tmp_path):
    for option in ("mask_weights", "depth_weights"):
        with pytest.raises(InputError, match=option.replace("_", "-") + " sam2-large: read by"):
            prepare(replace(clip, out=tmp_path / "scene", **{option: "sam2-large"}))
    assert not (tmp_path / "scene").exists()


def changed(weights: Path) -> None:
    """Other numbers under the same name."""
    from safetensors.torch import load_file, save_file

    tensors = load_file(weights)
    name = sorted(k for k, v in tensors.items() if v.is_floating_point())[0]
    save_file(tensors | {name: tensors[name] + 1}, weights, metadata={"format": "pt"})


CHANGED = ("static_depth", "response", "refined_flow", "movers", "depth", "sheet")


def test_a_step_is_done_again_where_its_weights_changed_under_their_name(
    clip, motion, tmp_path, monkeypatch
):
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path / "cache"))
    network = tiny_depth_anything(tmp_path / "cache/depth-anything", "relative")
    config = replace(clip, out=shutil.copytree(motion, tmp_path / "scene"), depth="depth-anything")

    def attempts() -> dict[str, int]:
        return {n: s.details["attempt"] for n, s in Manifest.load(prepare(config)).steps.items()}

    before = attempts()
    assert attempts() == before
    changed(network / "model.safetensors")
    assert attempts() == before | {n: before[n] + 1 for n in CHANGED}


def test_every_step_hashes_the_weights_it_reads(clip, tmp_path, monkeypatch):
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path / "cache"))
    for name in ("gmflow", "raft", "xfeat", "aliked", "aliked-lightglue"):
        monkeypatch.setitem(KNOWN, name, replace(KNOWN[name], sha256=None, inside=""))
        write_text(tmp_path / "cache" / name / str(KNOWN[name].file), name)
    write_text(tmp_path / "tuned/weights.safetensors", "tuned")
    for name in ("sam2", "depth-anything", "dinov2-small"):
        for file in ("config.json", "model.safetensors"):
            write_text(tmp_path / "cache" / name / file, name)
    tuned = {"flow": "raft-finetuned", "flow_weights": tmp_path / "tuned"}
    dinov2 = SemanticConfig(features="dinov2-small")
    read = {
        "gmflow": ("flow", {"flow": "gmflow"}),
        "raft": ("flow", {"flow": "raft"}),
        "xfeat": ("flow", {"flow": "semantic"}),
        "dinov2-small": ("flow", {"flow": "semantic", "semantic": dinov2}),
        "tuned": ("flow", tuned),
        "aliked-lightglue": ("poses", {"matcher": "aliked", "poses": None}),
        "sam2": ("masks", {"masks": "sam2"}),
        "depth-anything": ("static_depth", {"depth": "depth-anything"}),
    }
    for name, (step, chosen) in read.items():
        config = replace(clip, **chosen)
        found = weights_of(config, step)
        folder = tmp_path / "cache" / name if name != "tuned" else tmp_path / "tuned"
        file = next(p for p in folder.iterdir() if p.suffix != ".json")
        write_text(file, "something else")
        assert found and weights_of(config, step) != found, name
        assert not any(weights_of(config, other) for other in ("frames", "exposure", "sheet"))
    assert not any(
        weights_of(replace(clip, flow="dis", depth=None, poses=None), s)
        for s in ("flow", "poses", "masks", "static_depth")
    )


def test_a_known_file_that_changed_is_refused(clip, tmp_path, monkeypatch):
    monkeypatch.setenv("HDR_NSFF_WEIGHTS", str(tmp_path / "cache"))
    write_text(tmp_path / "cache/xfeat/xfeat.pt", "something else")
    with pytest.raises(InputError, match="has SHA-256"):
        weights_of(replace(clip, flow="semantic"), "flow")
