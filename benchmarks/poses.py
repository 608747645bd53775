"""Errors of the poses that `prepare` estimates, against other poses of the same frames.

    hdr-nsff prepare CLIP SCENE --hold-out 0
    python benchmarks/poses.py SCENE POSES

POSES is anything that `prepare --poses` reads. The file holds the share of registered
frames, the root mean square distance of camera centers after the best similarity (ATE,
and as a share of the path's extent), the mean rotation left after the best common
rotation, and the mean relative error of the focal length.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from record import Record, make_parser, name_of

from hdr_nsff.footage.pose_files import import_poses
from hdr_nsff.geometry import alignment
from hdr_nsff.scene.manifest import Manifest


def main() -> None:
    parser = make_parser(__doc__, "poses")
    parser.add_argument("scene", type=Path, help="a prepared scene")
    parser.add_argument("poses", type=Path, help="the poses it is compared with")
    args = parser.parse_args()
    record = Record("poses", args)
    record.add({"scene": name_of(args.scene)} | measure(args.scene, args.poses))
    record.save()


def measure(scene: Path, poses: Path) -> dict[str, float]:
    """Errors of the registered frames."""
    manifest = Manifest.load(scene)
    sources = [frame.source for frame in manifest.frames]
    given = import_poses(poses, sources, (manifest.height, manifest.width))
    registered = [k for k, frame in enumerate(manifest.frames) if frame.c2w is not None]
    estimated = np.array([manifest.frames[k].c2w for k in registered])
    K = np.array([manifest.frames[k].K for k in registered])
    result = {
        "frames": len(manifest.frames),
        "registered": len(registered) / len(manifest.frames),
    }
    result |= alignment.pose_errors(given.c2w[registered], estimated)
    result["focal_error"] = np.mean(K[:, 0, 0] / given.K[registered, 0, 0]) - 1
    return result


if __name__ == "__main__":
    main()
