"""The estimates of `prepare` for scenes in memory, for tests that change frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from hdr_nsff.priors.depth.geometric import (
    depth_range,
    lower_confidence_at_edges,
    static_geometric_depth,
)
from hdr_nsff.priors.movers.distance import mover_depth
from hdr_nsff.priors.movers.estimate import estimate_movers
from hdr_nsff.scene.movers import Mover, fill_mover_depth, write_movers
from hdr_nsff.scene.posed_video import PosedVideo
from hdr_nsff.scene.scene import Scene
from hdr_nsff.tonemap.base import Recordings, ToneMapConfig, ToneMapper
from hdr_nsff.tonemap.build import build_tone_mapper


def movers_of(scene: Scene) -> tuple[Mover, ...]:
    """The movers of a scene's training frames, from the maps in memory."""
    clip, flow, valid, pairs = video_of(scene)
    frames = scene.train
    disparity = np.stack([f.disparity.numpy() for f in frames])
    confidence = np.ones_like(disparity)
    movers = estimate_movers(clip, flow, valid, pairs, disparity, confidence)
    index = np.array([f.index for f in frames])
    return tuple(replace(mover, frames=index[mover.frames]) for mover in movers)


def video_of(scene: Scene) -> tuple[PosedVideo, np.ndarray, np.ndarray, np.ndarray]:
    """The training frames with poses, and the flow between them with its pairs."""
    frames, size = scene.train, scene.train[0].image.shape[:2]
    nothing = np.zeros(size, bool)
    clip = PosedVideo(
        np.stack([f.camera.K.double().numpy() for f in frames]),
        np.stack([f.camera.c2w.double().numpy() for f in frames]),
        np.array([f.time for f in frames]),
        np.stack([f.image.numpy() for f in frames]),
        np.zeros((len(frames), *size), bool),
        np.stack([nothing if f.moving is None else f.moving.numpy() for f in frames]),
    )
    pairs = [
        (i, f.neighbors[o], o)
        for i, f in enumerate(frames)
        for o in f.flow
        if f.neighbors.get(o, len(frames)) < len(frames)
    ]
    flow = [frames[i].flow[o].numpy() for i, _, o in pairs]
    valid = [frames[i].flow_valid[o].numpy() for i, _, o in pairs]
    return (
        clip,
        np.array(flow).reshape(-1, *size, 2),
        np.array(valid, bool).reshape(-1, *size),
        np.array([(i, j) for i, j, _ in pairs]).reshape(-1, 2),
    )


def with_movers(scene: Scene) -> Scene:
    """The scene with movers estimated from its present maps."""
    return replace(scene, movers=movers_of(scene))


def geometric_depth(
    clip: PosedVideo, flow: np.ndarray, valid: np.ndarray, pairs: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Disparity, confidence, near and far, by the steps `static_depth` to `depth`."""
    disparity, confidence, still = static_geometric_depth(clip, flow, valid, pairs, points)
    clip = replace(clip, moving=clip.moving & ~still)
    found, trust = mover_depth(clip, flow, valid, pairs, disparity)
    disparity = np.where(clip.moving, found, disparity)
    confidence = np.where(clip.moving, trust, confidence)
    movers = estimate_movers(clip, flow, valid, pairs, disparity, confidence)
    for t, k in enumerate(movers[0].frames if movers else []):
        disparity[k], confidence[k] = fill_mover_depth(
            movers, t, clip.moving[k], clip.c2w[k], disparity[k], confidence[k]
        )
    pairs_of_maps = zip(disparity, confidence, strict=True)
    confidence = np.stack([lower_confidence_at_edges(d, c) for d, c in pairs_of_maps])
    return disparity, confidence, *depth_range(disparity, confidence)


def forget_movers(folder: Path) -> None:
    """Leave a scene folder without movers, after its frames were edited."""
    write_movers(folder / "movers.npz", [])


def tone_mapper(
    brackets: list[int],
    cameras: list[int],
    ev: list[float | None],
    reference: int = 0,
    num_cameras: int | None = None,
    corners: tuple[float, ...] = (),
    **config,
) -> ToneMapper:
    """A tone mapper of the kind and settings in `config`, for frames as given."""
    count = num_cameras or max(cameras, default=0) + 1
    frames = tuple(brackets), tuple(cameras)
    recordings = Recordings(*frames, tuple(ev), reference, count, corners=corners)
    return build_tone_mapper(ToneMapConfig(**config), recordings)
