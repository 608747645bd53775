"""How good the priors of prepared scenes are: masks, depth, poses and flow against what
`synth` knows. The truth is read here only.

    hdr-nsff synth lamp CLIP
    hdr-nsff prepare CLIP/clip.mp4 SCENE --hold-out 0
    python benchmarks/priors.py SCENE:CLIP [SCENE:CLIP ...]

IoU of the moving masks over the whole clip, with precision and recall. Depth:
|ln(estimated / true)| as a percentage, median, at the scale of the camera path
(`metric`), and after the best scale per clip (`aligned`), of pixels that move and of
the others; `known` is the share whose confidence is above 0.5. Poses: registered share,
ATE as a share of the path's extent after the best similarity, mean rotation left, error
of the focal length. Flow to both neighbors: median and mean end-point error, of moving
pixels and of the others that the check believes.
"""

import argparse
from pathlib import Path

import numpy as np

from hdr_nsff.core.exr import MOTION_DIRECTIONS, read_exr
from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_json, read_npy, write_json
from hdr_nsff.geometry import alignment
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry, Manifest


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "pairs", nargs="+", help="SCENE:CLIP, a prepared scene and the folder that `synth` wrote"
    )
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = []
    for pair in args.pairs:
        scene, _, clip = pair.rpartition(":")
        assert scene, f"{pair}: write SCENE:CLIP"
        rows.append({"scene": Path(scene).name} | measure(Path(scene), Path(clip)))
        print(
            "\n".join(
                [
                    Path(scene).name,
                    *(f"  {k:28} {v:.4g}" for k, v in rows[-1].items() if k != "scene"),
                ]
            ),
            flush=True,
        )
    if args.json:
        write_json(args.json, rows)


def measure(scene: Path, clip: Path) -> dict[str, float]:
    """All numbers of one scene."""
    manifest = Manifest.load(scene)
    placed = [f for f in manifest.frames if f.c2w is not None]
    exact = {f.index: read_exr(clip / "exact" / f"clip_{f.index:05d}.exr") for f in placed}
    truth = read_json(clip / "truth" / "truth.json")
    true, own = (
        np.array(truth["clip_c2w"])[[f.index for f in placed]],
        np.array([f.c2w for f in placed]),
    )
    fit = alignment.umeyama(true[:, :, 3], own[:, :, 3])
    assert fit is not None, f"{scene}: the cameras fix no scale"
    told = {"registered": len(placed) / len(manifest.frames)} | alignment.pose_errors(true, own)
    mapped = [f for f in placed if f.mask and f.disparity]  # frames held out have no maps
    told["focal_error"] = placed[0].K[0][0] / truth["K"][0][0] - 1
    return (
        told
        | masks(scene, mapped, exact)
        | depths(scene, mapped, exact, fit.scale)
        | flows(scene, mapped, exact)
    )


def masks(
    scene: Path, frames: list[FrameEntry], exact: dict[int, dict[str, np.ndarray]]
) -> dict[str, float]:
    """Over all frames of the clip."""
    found = np.stack([read_mask(scene / str(f.mask)) for f in frames])
    moving = np.stack([exact[f.index]["body"] > 0 for f in frames])
    both = float((found & moving).sum())
    return {
        "mask_iou": both / (found | moving).sum(),
        "mask_precision": both / found.sum(),
        "mask_recall": both / moving.sum(),
    }


def depths(
    scene: Path, frames: list[FrameEntry], exact: dict[int, dict[str, np.ndarray]], scale: float
) -> dict[str, float]:
    """Log errors; `scale`: scene units per true unit."""
    off, moving, known = [], [], []
    for f in frames:
        disparity = read_npy(scene / str(f.disparity)).astype(np.float64)
        z = exact[f.index]["Z"]
        seen = np.isfinite(z) & (z > 0) & (disparity > 0)
        off.append(-np.log(disparity[seen] * z[seen] * scale))
        moving.append(exact[f.index]["body"][seen] > 0)
        known.append(read_npy(scene / str(f.disparity_confidence))[seen] > 0.5)
    log, moves, sure = np.concatenate(off), np.concatenate(moving), np.concatenate(known)
    told = {}
    for name, where in (("moving", moves), ("still", ~moves)):
        told[f"depth_{name}_metric_percent"] = 100 * float(np.median(np.abs(log[where])))
        told[f"depth_{name}_aligned_percent"] = 100 * float(
            np.median(np.abs(log[where] - np.median(log)))
        )
        told[f"depth_{name}_known"] = float(sure[where].mean())
    return told


def flows(
    scene: Path, frames: list[FrameEntry], exact: dict[int, dict[str, np.ndarray]]
) -> dict[str, float]:
    """End-point errors of the flow to the frames beside, where it is believed; and by
    how much movers are too slow before what is at rest, flow as it was matched and as
    training sees it.
    """
    error, moving, believed = [], [], []
    slow = {"matched": np.zeros(2), "flow": np.zeros(2)}
    for f in frames:
        for side, name in MOTION_DIRECTIONS.items():
            if f.index + side not in f.flow:
                continue
            files, there = f.flow[f.index + side], exact[f.index]
            true = np.stack([there[f"{name}.u"], there[f"{name}.v"]], -1)
            error.append(
                np.linalg.norm(read_npy(scene / files.flow).astype(np.float32) - true, axis=-1)
            )
            moving.append(there["body"] > 0)
            believed.append(read_mask(scene / files.valid))
            for kind in slow:
                slow[kind] += missed(
                    scene, getattr(f, kind).get(f.index + side, files), true, moving[-1]
                )
    e, m, b = (np.stack(v) for v in (error, moving, believed))
    parts = {"moving": e[b & m], "still": e[b & ~m]}
    told = {
        f"flow_{n}_{w}_px": float(f(p))
        for n, p in parts.items()
        for w, f in (("median", np.median), ("mean", np.mean))
    }
    told |= {
        f"{kind}_too_slow_percent": float(100 * part / max(whole, 1e-9))
        for kind, (part, whole) in slow.items()
    }
    return told | {
        "flow_moving_believed": float(b[m].mean()),
        "flow_still_believed": float(b[~m].mean()),
    }


def missed(scene: Path, files: FlowFiles, true: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Sums (2,) over the movers' believed pixels: of what the flow misses along their
    motion before what is at rest, and of that motion, squared.
    """
    found, believed = (
        read_npy(scene / files.flow).astype(np.float32),
        read_mask(scene / files.valid),
    )
    motion = true - np.median(true[~moving], axis=0)
    some = moving & believed
    return np.array([((true - found) * motion)[some].sum(), (motion[some] ** 2).sum()])


if __name__ == "__main__":
    main()
