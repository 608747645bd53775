"""An oracle: a scene folder whose poses and masks are exact and whose depth and flow
are exact up to a little noise.

It measures a field and its training apart from the priors. It is made from the truth,
says so in every step of its manifest, and is no input that a user could have. Flow goes
from a frame to the ones before and after, whichever cameras they are of:
`scene.neighbors` links consecutive times of one `camera_id`, so the cameras of a rig
that take turns share id 0.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.exr import MOTION_DIRECTIONS
from hdr_nsff.core.images import read_image, read_mask, write_png
from hdr_nsff.core.io import read_npy, write_npy
from hdr_nsff.core.progress import say
from hdr_nsff.priors.movers.estimate import estimate_movers
from hdr_nsff.priors.movers.rigidity import judge_rigidity
from hdr_nsff.radiometry.estimate_response import estimate_response
from hdr_nsff.radiometry.static_samples import ResponseView
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry, Manifest, StepRecord
from hdr_nsff.scene.movers import write_movers
from hdr_nsff.scene.posed_video import PosedVideo
from hdr_nsff.scene.response import write_response
from hdr_nsff.synth.motion import depth_there
from hdr_nsff.synth.scenes.base import SynthScene
from hdr_nsff.synth.scenes.geometry import back_project

ORACLE_NOTE = "oracle: from truth"
MAX_DEPTH_GAP = 0.02  # relative: two views of one surface differ less (hand-chosen)
POINTS_PER_FRAME = 200  # about as many as structure from motion finds
DEPTH_MARGIN = 0.05  # relative: near and far are this much beyond the depths


@dataclass(frozen=True)
class OracleNoise:
    """How far depth and flow are from exact, in standard deviations."""

    depth: float = 0.03  # relative, smooth over an eighth of the frame
    grain: float = 0.0  # relative, every pixel for itself
    flow: float = 0.3  # pixels, every pixel for itself
    seed: int = 0


def write_oracle(
    out: Path,
    scene: SynthScene,
    exact: list[dict[str, np.ndarray]],
    video: np.ndarray,
    K: np.ndarray,
    c2w: list[np.ndarray],
    ev: list[float],
    reference: int,
    noise: OracleNoise,
    rig: int = 1,
) -> None:
    """Write `out`/oracle from the rendered channels of every frame (`exact`), the
    recorded `video` (T, H, W, 3), poses (3, 4) and the exposures of the brackets;
    `rig`: how many cameras take the frames in turn.
    """
    folder = out / "oracle"
    rng = np.random.default_rng(noise.seed)
    count, height, width = video.shape[:3]
    depths = np.stack([channels["Z"] for channels in exact])
    surfaces = depths > 0
    nearest, farthest = float(depths[surfaces].min()), float(depths[surfaces].max())
    depths[~surfaces] = np.inf  # the sky
    entries = [frame_entry(i, count, K, c2w[i], ev) for i in range(count)]
    certain = np.ones((height, width), np.float16)
    for i, (channels, entry) in enumerate(zip(exact, entries, strict=True)):
        error = depth_error(noise, (height, width), rng, i)
        disparity = np.exp(error) / depths[i]
        write_png(folder / entry.image, video[i])
        write_png(folder / f"masks/{i:05d}.png", channels["body"] > 0)
        write_npy(folder / f"disparity/{i:05d}.npy", disparity.astype(np.float16))
        write_npy(folder / f"disparity_confidence/{i:05d}.npy", certain)
        for j, files in entry.flow.items():
            flow = rendered_flow(channels, j - i)
            valid = visible(flow, depth_there(scene, channels, K, c2w, i, j), depths[j])
            noisy = flow + noise.flow * rng.normal(size=flow.shape)
            write_png(folder / files.valid, valid)
            write_npy(folder / files.flow, noisy.astype(np.float16))
    write_npy(folder / "points.npy", static_points(exact, K, c2w, rng))
    steps = ("frames", "exposure", "poses", "masks", "flow", "depth")
    manifest = Manifest(
        source="clip",
        width=width,
        height=height,
        cycle=len(ev),
        rig=rig,
        reference_bracket=reference,
        bracket_ev=list(ev),
        exposure_given=True,
        near=(1 - DEPTH_MARGIN) * nearest,
        far=(1 + DEPTH_MARGIN) * farthest,
        points="points.npy",
        response="response.json",
        movers="movers.npz",
        frames=entries,
        steps={name: StepRecord(done=True, provenance="given", note=ORACLE_NOTE) for name in steps},
    )
    write_estimates(folder, manifest, video)
    manifest.save(folder)


def remove_stale(out: Path) -> None:
    """Remove `out`/oracle where its frames are not those of `out`/clip, because it was
    made with other settings. A folder that is no readable oracle stays.
    """
    folder = out / "oracle"
    try:
        manifest = Manifest.load(folder)
        if not any(step.note == ORACLE_NOTE for step in manifest.steps.values()):
            return
        pairs = [(folder / f.image, out / f.source) for f in manifest.frames]
        if all(np.array_equal(read_image(a), read_image(b)) for a, b in pairs):
            return
    except InputError:
        return
    shutil.rmtree(folder)
    say(f"{folder}: removed, it was of other settings; add --oracle to write it again")


def write_estimates(folder: Path, manifest: Manifest, video: np.ndarray) -> None:
    """What `prepare` would estimate from the other parts: response and movers."""
    frames = manifest.frames
    disparity = read_maps(folder, [str(f.disparity) for f in frames])
    moving = np.stack([read_mask(folder / str(f.mask)) for f in frames])
    K, c2w = np.array([f.K for f in frames]), np.array([f.c2w for f in frames])
    views = [
        ResponseView(video[i], f.bracket, f.time, K[i], c2w[i], disparity[i], None, moving[i])
        for i, f in enumerate(frames)
    ]
    known, reference = manifest.known_ev, manifest.reference_bracket
    response = estimate_response(views, [0] * len(frames), known, reference, num_cameras=1)
    write_response(folder / "response.json", response)
    times = np.array([f.time for f in frames])
    clip = PosedVideo(K, c2w, times, video, np.zeros(moving.shape, bool), moving)
    pairs = [(f.index, j) for f in frames for j in f.flow]
    files = [frames[i].flow[j] for i, j in pairs]
    flow = read_maps(folder, [f.flow for f in files])
    valid = np.stack([read_mask(folder / f.valid) for f in files])
    confidence = np.ones_like(disparity)
    links = flow, valid, np.array(pairs)
    movers = estimate_movers(clip, *links, disparity, confidence)
    movers = judge_rigidity(movers, clip, *links, disparity)
    write_movers(folder / "movers.npz", movers)


def read_maps(folder: Path, names: list[str]) -> np.ndarray:
    """Maps of one size, stacked, in single precision."""
    return np.stack([read_npy(folder / name).astype(np.float32) for name in names])


def frame_entry(i: int, count: int, K: np.ndarray, c2w: np.ndarray, ev: list[float]) -> FrameEntry:
    """Frame `i` of `count` in the manifest, with the places of its maps."""
    flow = {}
    for j in (i - 1, i + 1):
        if 0 <= j < count:
            pair = f"flow/{i:05d}_{j:05d}"
            flow[j] = FlowFiles(flow=f"{pair}.npy", valid=f"{pair}_valid.png")
    return FrameEntry(
        index=i,
        image=f"images/{i:05d}.png",
        source=f"clip/{i:05d}.png",
        time=float(i),
        bracket=i % len(ev),
        ev=ev[i % len(ev)],
        K=K.tolist(),
        c2w=c2w.tolist(),
        mask=f"masks/{i:05d}.png",
        disparity=f"disparity/{i:05d}.npy",
        disparity_confidence=f"disparity_confidence/{i:05d}.npy",
        flow=flow,
    )


def depth_error(
    noise: OracleNoise, size: tuple[int, int], rng: np.random.Generator, frame: int
) -> np.ndarray:
    """The error (H, W) of a frame's log disparity: a smooth part, and grain from a
    generator of its own.
    """
    coarse = rng.normal(size=(8, 8)).astype(np.float32)
    smooth = cv2.resize(coarse, size[::-1], interpolation=cv2.INTER_CUBIC)
    grain = np.random.default_rng([noise.seed, frame, 1]).normal(size=size)
    return noise.depth * smooth + noise.grain * grain


def rendered_flow(channels: dict[str, np.ndarray], side: int) -> np.ndarray:
    """The rendered flow (H, W, 2) px to the next (+1) or previous (-1) frame."""
    name = MOTION_DIRECTIONS[side]
    return np.stack([channels[f"{name}.u"], channels[f"{name}.v"]], -1)


def visible(flow: np.ndarray, expected: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Where a surface is inside the other frame and not hidden there, (H, W) bool: its
    `expected` depth (H, W) agrees with the other frame's `depth` (H, W) at one of the
    four pixels around.
    """
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    left = np.floor(x + flow[..., 0]).astype(int)
    top = np.floor(y + flow[..., 1]).astype(int)
    inside = (left >= 0) & (top >= 0) & (left < width - 1) & (top < height - 1)
    left = left.clip(0, width - 2)
    top = top.clip(0, height - 2)
    around = np.stack([depth[top + dy, left + dx] for dy in (0, 1) for dx in (0, 1)])  # (4, H, W)
    gap = np.abs(around / expected - 1).min(0)
    return inside & (gap < MAX_DEPTH_GAP)


def static_points(
    exact: list[dict[str, np.ndarray]],
    K: np.ndarray,
    c2w: list[np.ndarray],
    rng: np.random.Generator,
) -> np.ndarray:
    """Static points (P, 3), up to 200 of each frame, as structure from motion would
    give.
    """
    points = []
    for channels, pose in zip(exact, c2w, strict=True):
        y, x = np.nonzero((channels["body"] == 0) & (channels["Z"] > 0))
        chosen = rng.choice(len(x), min(POINTS_PER_FRAME, len(x)), replace=False)
        points.append(back_project(channels["Z"], K, pose)[y[chosen], x[chosen]])
    return np.concatenate(points).astype(np.float32)
