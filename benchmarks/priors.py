"""Errors of a prepared scene's masks, depth, poses and flow against rendered truth.

    hdr-nsff synth lamp CLIP
    hdr-nsff prepare CLIP/clip.mp4 SCENE --hold-out 0
    python benchmarks/priors.py SCENE:CLIP [SCENE:CLIP ...]

The file holds, for every scene:

- masks: IoU of the moving masks over the whole clip, precision and recall;
- depth: median of |ln(estimated / true)| as a percentage, at the scale of the camera
  path (`metric`) and after the best scale of the clip (`aligned`), of moving and of
  static pixels; `known` is the share of pixels whose confidence is above 0.5;
- distance of movers: of ln(estimated / true) at each moving body's median pixel, the
  standard deviation over time (`distance_drift_percent`) and the absolute mean
  (`distance_bias_percent`), averaged over bodies by their pixels;
- poses: share of registered frames, ATE as a share of the path's extent after the best
  similarity, mean remaining rotation, error of the focal length;
- flow to both neighbors: median and mean end-point error of valid pixels, and how much
  of the movers' motion relative to the background is missing (`too_slow`).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from record import Record, make_parser, name_of

from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr
from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_json, read_npy
from hdr_nsff.geometry import alignment
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry, Manifest

Truth = dict[int, dict[str, np.ndarray]]  # the channels of the exact frames, by index
MIN_BODY_PX = 20  # of a body in a frame, to have a distance
MIN_BODY_FRAMES = 4  # with such a distance
KNOWN_CONFIDENCE = 0.5  # depth counts as known above this


def main() -> None:
    parser = make_parser(__doc__, "priors")
    parser.add_argument(
        "pairs",
        nargs="+",
        type=scene_and_clip,
        metavar="SCENE:CLIP",
        help="a prepared scene and the folder that `synth` wrote",
    )
    args = parser.parse_args()
    record = Record("priors", args)
    for scene, clip in args.pairs:
        row = {"scene": name_of(scene), "clip": name_of(clip)} | measure(scene, clip)
        record.add(row, show=False)
        print(f"{row['scene']} ({row['clip']})")
        for name, value in row.items():
            if isinstance(value, float):
                print(f"  {name:28} {value:.4g}")
    record.save()


def scene_and_clip(text: str) -> tuple[Path, Path]:
    """SCENE:CLIP as two folders."""
    scene, _, clip = text.rpartition(":")
    if not scene:
        raise argparse.ArgumentTypeError(f"{text!r}: write SCENE:CLIP")
    return Path(scene), Path(clip)


def measure(scene: Path, clip: Path) -> dict[str, float]:
    """All errors of one scene."""
    manifest = Manifest.load(scene)
    registered = [frame for frame in manifest.frames if frame.c2w is not None]
    exact = {
        frame.index: read_exr(clip / "exact" / f"clip_{frame.index:05d}.exr")
        for frame in registered
    }
    truth = read_json(clip / "truth" / "truth.json")
    true_poses = np.array(truth["clip_c2w"])[[frame.index for frame in registered]]
    poses = np.array([frame.c2w for frame in registered])
    similarity = alignment.umeyama(true_poses[:, :, 3], poses[:, :, 3])
    assert similarity is not None, f"{scene}: the camera does not move enough to fix a scale"
    focal_length = np.array(registered[0].K)[0, 0]
    result = {"registered": len(registered) / len(manifest.frames)}
    result |= alignment.pose_errors(true_poses, poses)
    result["focal_error"] = focal_length / truth["K"][0][0] - 1
    with_maps = [f for f in registered if f.mask and f.disparity]  # held-out frames have none
    result |= mask_errors(scene, with_maps, exact)
    result |= depth_errors(scene, with_maps, exact, similarity.scale)
    result |= distance_errors(scene, with_maps, exact, similarity.scale)
    result |= flow_errors(scene, with_maps, exact)
    return result


def mask_errors(scene: Path, frames: list[FrameEntry], exact: Truth) -> dict[str, float]:
    """Over all pixels of all frames."""
    masks = np.stack([read_mask(scene / str(frame.mask)) for frame in frames])
    moving = np.stack([exact[frame.index]["body"] > 0 for frame in frames])
    intersection = float((masks & moving).sum())
    return {
        "mask_iou": intersection / float((masks | moving).sum()),
        "mask_precision": intersection / float(masks.sum()),
        "mask_recall": intersection / float(moving.sum()),
    }


def depth_errors(
    scene: Path, frames: list[FrameEntry], exact: Truth, scale: float
) -> dict[str, float]:
    """Log errors of pixels with a depth; `scale`: scene units per true unit."""
    errors, moving, known = [], [], []
    for frame in frames:
        disparity = read_npy(scene / str(frame.disparity)).astype(np.float64)
        confidence = read_npy(scene / str(frame.disparity_confidence))
        z = exact[frame.index]["Z"]
        valid = np.isfinite(z) & (z > 0) & (disparity > 0)
        errors.append(-np.log(disparity[valid] * z[valid] * scale))
        moving.append(exact[frame.index]["body"][valid] > 0)
        known.append(confidence[valid] > KNOWN_CONFIDENCE)
    error, is_moving = np.concatenate(errors), np.concatenate(moving)
    is_known = np.concatenate(known)
    aligned = error - np.median(error)
    result = {}
    for name, part in (("moving", is_moving), ("static", ~is_moving)):
        metric_error = float(np.median(np.abs(error[part])))
        aligned_error = float(np.median(np.abs(aligned[part])))
        result[f"depth_{name}_metric_percent"] = 100 * metric_error
        result[f"depth_{name}_aligned_percent"] = 100 * aligned_error
        result[f"depth_{name}_known"] = float(is_known[part].mean())
    return result


def distance_errors(
    scene: Path, frames: list[FrameEntry], exact: Truth, scale: float
) -> dict[str, float]:
    """How the distance of every moving body is wrong over time, and on average."""
    errors: dict[int, list[float]] = {}
    pixels: dict[int, int] = {}
    for frame in frames:
        disparity = read_npy(scene / str(frame.disparity)).astype(np.float64)
        z, body = exact[frame.index]["Z"], exact[frame.index]["body"].round().astype(int)
        for index in np.unique(body[body > 0]).tolist():
            part = (body == index) & np.isfinite(z) & (z > 0) & (disparity > 0)
            if part.sum() >= MIN_BODY_PX:
                log_error = -np.log(disparity[part] * z[part] * scale)
                errors.setdefault(index, []).append(float(np.median(log_error)))
                pixels[index] = pixels.get(index, 0) + int(part.sum())
    often = [index for index, values in errors.items() if len(values) >= MIN_BODY_FRAMES]
    weights = [pixels[index] for index in often]
    drift = np.average([np.std(errors[index]) for index in often], weights=weights)
    bias = np.average([abs(np.mean(errors[index])) for index in often], weights=weights)
    return {
        "distance_drift_percent": 100 * float(drift),
        "distance_bias_percent": 100 * float(bias),
    }


def flow_errors(scene: Path, frames: list[FrameEntry], exact: Truth) -> dict[str, float]:
    """End-point errors of the flow to both neighbors, where it is valid.

    `raw_flow_too_slow` and `flow_too_slow` are the share of the movers' motion that is
    missing from the flow as it was matched, and from the flow that training reads.
    """
    errors, moving, valid = [], [], []
    missing = {"raw_flow": np.zeros(2), "flow": np.zeros(2)}
    for frame in frames:
        for offset, direction in MOTION_DIRECTIONS.items():
            neighbor = frame.index + offset
            if neighbor not in frame.flow:
                continue
            files, channels = frame.flow[neighbor], exact[frame.index]
            true = np.stack([channels[f"{direction}.u"], channels[f"{direction}.v"]], -1)
            flow = read_npy(scene / files.flow).astype(np.float32)
            errors.append(np.linalg.norm(flow - true, axis=-1))
            moving.append(channels["body"] > 0)
            valid.append(read_mask(scene / files.valid))
            for kind in missing:
                files_of_kind = getattr(frame, kind).get(neighbor, files)
                missing[kind] += missing_motion(scene, files_of_kind, true, moving[-1])
    error, is_moving, is_valid = np.stack(errors), np.stack(moving), np.stack(valid)
    result = {}
    for name, part in (("moving", is_moving), ("static", ~is_moving)):
        result[f"flow_{name}_median_px"] = float(np.median(error[is_valid & part]))
        result[f"flow_{name}_mean_px"] = float(error[is_valid & part].mean())
        result[f"flow_{name}_valid"] = float(is_valid[part].mean())
    for kind, (part_missing, whole) in missing.items():
        result[f"{kind}_too_slow_percent"] = float(100 * part_missing / max(whole, 1e-9))
    return result


def missing_motion(
    scene: Path, files: FlowFiles, true: np.ndarray, moving: np.ndarray
) -> np.ndarray:
    """Sums (2,) over valid moving pixels, along the motion relative to the background.

    The first is what the flow misses of that motion, the second the motion squared.
    """
    flow = read_npy(scene / files.flow).astype(np.float32)
    valid = read_mask(scene / files.valid)
    relative = true - np.median(true[~moving], axis=0)
    chosen = moving & valid
    missed = ((true - flow) * relative)[chosen].sum()
    return np.array([missed, (relative[chosen] ** 2).sum()])


if __name__ == "__main__":
    main()
