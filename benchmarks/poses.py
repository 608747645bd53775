"""How far the poses that `prepare` found are from poses made elsewhere of the same
frames.

    hdr-nsff prepare CLIP SCENE --hold-out 0
    python benchmarks/poses.py SCENE POSES

POSES is whatever `prepare --poses` reads. Prints the share of frames that were placed;
the root mean square distance of their centers after the best similarity (ATE) as a
share of the path's extent, the mean angle left after the best common rotation, and by
how much focal lengths differ.
"""

import argparse
from pathlib import Path

import numpy as np

from hdr_nsff.footage.pose_files import import_poses
from hdr_nsff.geometry import alignment
from hdr_nsff.scene.manifest import Manifest


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", type=Path, help="a prepared scene")
    parser.add_argument("poses", type=Path)
    args = parser.parse_args()
    manifest = Manifest.load(args.scene)
    given = import_poses(
        args.poses, [f.source for f in manifest.frames], (manifest.height, manifest.width)
    )
    placed = [k for k, f in enumerate(manifest.frames) if f.c2w is not None]
    errors = alignment.pose_errors(
        given.c2w[placed], np.array([manifest.frames[k].c2w for k in placed])
    )
    print(f"registered {len(placed)} of {len(manifest.frames)}")
    print("\n".join(f"{name} {value:.4g}" for name, value in errors.items()))
    focal_ratios = [manifest.frames[k].K[0][0] / given.K[k][0, 0] for k in placed]
    print(f"focal length {np.mean(focal_ratios) - 1:+.2%}")


if __name__ == "__main__":
    main()
