"""What holds a result back: a prepared scene with some of its priors replaced by those
of an oracle scene of the same clip. ORACLE RUNS: what is trained on such a folder says
what a better prior would bring, not what the product does.

    hdr-nsff synth interior CLIP --oracle
    python benchmarks/replace_priors.py SCENE CLIP/oracle OUT --what masks mover-depth
    flow
    hdr-nsff train splat --scene OUT --out RUN --steps 1500 && hdr-nsff evaluate RUN
    --truth CLIP/truth

Poses stay the scene's own; the oracle's depth is brought to its units by the similarity
of the camera paths. `depth` is that of all pixels.
"""

import argparse
import shutil
from pathlib import Path

import numpy as np

from hdr_nsff.core.images import read_mask
from hdr_nsff.core.io import read_npy, write_npy
from hdr_nsff.geometry import alignment
from hdr_nsff.scene.manifest import FrameEntry, Manifest

PRIORS = ("masks", "mover-depth", "depth", "flow")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path)
    parser.add_argument("oracle", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--what", nargs="+", choices=PRIORS, required=True)
    args = parser.parse_args()
    manifest, oracle = Manifest.load(args.scene), Manifest.load(args.oracle)
    assert len(manifest.frames) == len(oracle.frames), (
        "two scenes of one clip have equally many frames"
    )
    shutil.copytree(args.scene, args.out)
    fit = alignment.umeyama(
        *(np.array([f.c2w for f in m.frames])[:, :, 3] for m in (oracle, manifest))
    )
    assert fit is not None, "the cameras fix no scale"
    for own, exact in zip(manifest.frames, oracle.frames, strict=True):
        if "depth" in args.what or "mover-depth" in args.what:
            replace_depth(
                args.out, own, args.oracle, exact, fit.scale, everywhere="depth" in args.what
            )
        if "masks" in args.what:
            shutil.copy(args.oracle / str(exact.mask), args.out / str(own.mask))
        for other in own.flow.keys() & exact.flow.keys() if "flow" in args.what else ():
            shutil.copy(args.oracle / exact.flow[other].flow, args.out / own.flow[other].flow)
            shutil.copy(args.oracle / exact.flow[other].valid, args.out / own.flow[other].valid)
    for name in steps_of(args.what):
        manifest.steps[name] = manifest.steps[name].model_copy(
            update={"provenance": "given", "note": "of an oracle"}
        )
    manifest.save(args.out)
    print(f"oracle scene: {args.out}, with the true {', '.join(args.what)}")


def steps_of(what: list[str]) -> set[str]:
    """The steps of `prepare` that are no longer the clip's own."""
    return {{"mover-depth": "depth"}.get(w, w) for w in what}


def replace_depth(
    out: Path, own: FrameEntry, oracle: Path, exact: FrameEntry, scale: float, everywhere: bool
) -> None:
    """The oracle's disparity (its units over ours: `scale`), fully trusted, where it
    moves or everywhere.
    """
    where = np.ones(1, bool) if everywhere else read_mask(oracle / str(exact.mask))
    disparity = read_npy(oracle / str(exact.disparity)).astype(np.float32) / scale
    write_npy(
        out / str(own.disparity),
        np.where(where, disparity, read_npy(out / str(own.disparity))).astype(np.float16),
    )
    if own.disparity_confidence:
        path = out / own.disparity_confidence
        write_npy(path, np.where(where, 1, read_npy(path)).astype(np.float16))


if __name__ == "__main__":
    main()
