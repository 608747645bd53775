"""Camera poses from frames alone: structure from motion on exposure-equalized frames
with moving objects left out.

Footage without parallax (tripod, pan) is recognized first and gets rotations instead
(`rotation.py`). Otherwise pycolmap maps the frames (`sfm.py`): incrementally, then
globally, with and without leveled contrast, until nine frames in ten register with a
focal length that a lens can have. Poses are camera to world, OpenCV axes; the world's
+z is the mean viewing direction, near is 1.
"""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import encode
from hdr_nsff.core.progress import say
from hdr_nsff.footage.colmap import ColmapModel, read_model
from hdr_nsff.geometry.pinhole import intrinsics
from hdr_nsff.geometry.poses import (
    ADVICE,
    LEAST,
    Poses,
    interpolate,
    project,
    ranges,
    trusted_points,
)
from hdr_nsff.priors.poses import sfm
from hdr_nsff.priors.poses.lightglue import Matcher, enlarged, match_pictures
from hdr_nsff.priors.poses.matching import (
    camera_groups,
    keypoints,
    match_all,
    picture,
    spread_pairs,
    upsampling,
    usable,
    view_pairs,
)
from hdr_nsff.priors.poses.rotation import Panorama, default_focal, panorama, rotation_share

FOV = (25.0, 100.0)  # degrees across the image that an undistorted video camera plausibly sees
# share of static matches rotations must explain before footage counts as without
# parallax (measured: 0.84+ against 0.42-)
ROTATION = 0.7
PERHAPS = 0.5  # the same where structure from motion has failed
STILL = 0.75  # pixels that a camera on a tripod may seem to move
LOOK = 24  # frames looked at to decide about parallax
ENOUGH = 0.9  # share of frames to be content with


@dataclass(frozen=True)
class Views:
    """The pictures to map: one per frame, but a single one for all frames of a camera
    that stands still.
    """

    pictures: np.ndarray  # (V, H, W, 3) equalized rgb in [0, 1]
    ignore: np.ndarray  # (V, H, W) bool
    groups: list[list[int]]  # views of each physical camera
    of_frame: np.ndarray  # (T,) which view shows each frame


def estimate_poses(
    video: np.ndarray,
    masks: np.ndarray | None,
    workdir: Path | str,
    clipped: np.ndarray | None = None,
    camera_ids: list[int] | None = None,
    threads: int = 0,
    matcher: Matcher = "sift",
) -> Poses:
    """Poses of every frame of `video` (T, H, W, 3), exposure-equalized rgb in [0, 1].

    `masks` (T, H, W) bool moving; `clipped` (T, H, W) bool without information;
    `camera_ids` (T,) the physical camera of each frame (each has its own focal length),
    by default one. `matcher` finds and matches keypoints for structure from motion.
    Temporary files go into `workdir`. InputError where poses cannot be had.
    """
    count = len(video)
    if count < 3:
        raise InputError(
            f"{count} frames are too few to estimate poses from; give at least 3, or import poses (--poses)"
        )
    ignore = np.any(
        [m for m in (masks, clipped) if m is not None] or np.zeros((1, *video.shape[:3]), bool), 0
    )
    groups = camera_groups(camera_ids or [0] * count)
    share = turning_share(video, ignore) if len(groups) == 1 else None
    found = standing(video, ignore) if share is not None and share >= ROTATION else None
    if found is None:
        views = collapse(video, ignore, groups)
        try:
            model, scale = best_model(views, Path(workdir), threads, matcher)
            found = assemble(model, views, scale, video.shape[1:3])
        except InputError as error:
            found = standing(video, ignore) if share is not None and share >= PERHAPS else None
            if found is None:
                raise
            found = replace(
                found, notes=(f"taken as a camera that turns in place, since {error}", *found.notes)
            )
    for note in found.notes:
        say(f"poses: {note}")
    return found


def turning_share(video: np.ndarray, ignore: np.ndarray) -> float | None:
    """`rotation_share` of up to 24 frames spread over the clip."""
    chosen = np.unique(np.linspace(0, len(video) - 1, min(LOOK, len(video))).astype(int))
    matches = match_all(
        keypoints(video[chosen], ignore[chosen], 1000), view_pairs([list(range(len(chosen)))])
    )
    height, width = video.shape[1:3]
    found = panorama(matches, len(chosen), width, height)
    share = None if found is None else rotation_share(matches, found, width, height)
    return share if found is None or share is None or not found.slides else min(share, PERHAPS)


def turning(video: np.ndarray, ignore: np.ndarray) -> Panorama | None:
    """The rotations of one camera, all of its frames taken together."""
    matches = match_all(keypoints(video, ignore, 1000), spread_pairs(len(video)))
    return panorama(matches, len(video), video.shape[2], video.shape[1])


def standing(video: np.ndarray, ignore: np.ndarray) -> Poses | None:
    """Poses of a camera on a tripod or turning in place; None where rotations do not
    explain the footage after all.
    """
    found = turning(video, ignore)
    if found is None or found.explained < 0.8 or found.linked.mean() < LEAST:
        return None
    count, height, width = video.shape[:3]
    still = found.motion < STILL
    c2w = np.zeros((count, 3, 4))
    c2w[:, :, :3] = np.eye(3) if still else found.rotations
    notes = [
        "no parallax: the camera "
        + ("stands still" if still else f"turns in place (by up to {found.motion:.0f} px)")
        + "; HDR video and in-between times work, novel viewpoints do not"
    ]
    notes.append(
        f"focal length {found.focal:.0f} px, "
        + ("from the turn" if found.focal_known else "assumed: 60 degrees across")
    )
    poses = Poses(
        K=np.tile(intrinsics(found.focal, width, height), (count, 1, 1)),
        c2w=c2w,
        registered=found.linked | still,
        parallax="none" if still else "rotation",
        frame_errors=found.errors,
        notes=tuple(notes),
    )
    return interpolate(poses, [list(range(count))])


def collapse(video: np.ndarray, ignore: np.ndarray, groups: list[list[int]]) -> Views:
    """One view per frame; of a rig's cameras that stand still, one view per camera: the
    median of its frames, free of most movers.
    """
    if len(groups) == 1:
        return Views(video, ignore, groups, np.arange(len(video)))
    pictures: list[np.ndarray] = []
    hidden: list[np.ndarray] = []
    views: list[list[int]] = []
    of_frame = np.zeros(len(video), int)
    for group in groups:
        chosen = [
            group[k]
            for k in np.unique(np.linspace(0, len(group) - 1, min(LOOK, len(group))).astype(int))
        ]
        found = turning(video[chosen], ignore[chosen]) if len(group) > 1 else None
        first = len(pictures)
        if found is not None and found.motion < STILL and found.explained > 0.8:
            covered = ignore[chosen] & ~ignore[chosen].all(
                0
            )  # what is never free is taken as it is, and stays ignored
            pictures.append(np.nanmedian(np.where(covered[..., None], np.nan, video[chosen]), 0))
            hidden.append(np.all(ignore[chosen], 0))
            of_frame[group] = first
        else:
            pictures += [video[t] for t in group]
            hidden += [ignore[t] for t in group]
            of_frame[group] = first + np.arange(len(group))
        views.append(list(range(first, len(pictures))))
    return Views(np.stack(pictures), np.stack(hidden), views, of_frame)


def best_model(
    views: Views, workdir: Path, threads: int, matcher: Matcher
) -> tuple[ColmapModel, int]:
    """The best reconstruction of the views, and how much larger than the views its
    pictures were. InputError where none will do.
    """
    count = len(views.pictures)
    best: ColmapModel | None = None
    scale = upsampling(views.pictures.shape[2])
    failures = []
    for leftover in workdir.glob(".sfm-*"):
        shutil.rmtree(leftover, ignore_errors=True)
    workdir.mkdir(parents=True, exist_ok=True)
    for level in (
        (True, False) if matcher == "sift" else (False,)
    ):  # learned keypoints see color, and one contrast is as good as another
        with tempfile.TemporaryDirectory(prefix=".sfm-", dir=workdir) as folder:
            job = write_job(Path(folder), views, scale, level, threads, matcher)
            for mapping in ("incremental", "global"):
                try:
                    models = [read_model(p) for p in sfm.run(replace(job, mapping=mapping))]
                except sfm.SfmError as error:
                    failures.append(str(error))
                    continue
                best = max(
                    [m for m in (best, *models) if m is not None],
                    key=lambda m: worth(m, count),
                    default=None,
                )
                if best is not None and worth(best, count)[:2] == (True, True):
                    return best, scale
                got = 0 if best is None else len(best.images)
                say(
                    f"poses: {mapping} mapping ({'leveled' if level else 'plain'} contrast): at best {got} of {count} so far"
                )
    if best is None or not plausible(best) or len(best.images) < LEAST * count:
        raise InputError(sentence(best, views, failures))
    return best, scale


def write_job(
    folder: Path, views: Views, scale: int, level: bool, threads: int, matcher: Matcher
) -> sfm.Job:
    """The pictures and masks on disk, with learned matches if those are wanted, and
    what to do with them.
    """
    names = [f"{v:05d}.png" for v in range(len(views.pictures))]
    for v, name in enumerate(names):
        encode(folder / "images" / name, picture(views.pictures[v], scale, level))
        encode(folder / "masks" / f"{name}.png", usable(views.ignore[v], scale))
    wanted = view_pairs(views.groups)
    pairs = [(names[a], names[b]) for a, b in wanted]
    if matcher != "sift":
        shown = [enlarged(p, scale) for p in views.pictures]
        found, matches = match_pictures(
            shown, [usable(i, scale) for i in views.ignore], wanted, matcher
        )
        sfm.write_matches(folder, names, found, pairs, matches)
    return sfm.Job(
        folder=str(folder),
        groups=[[names[v] for v in group] for group in views.groups],
        pairs=pairs,
        focal=default_focal(views.pictures.shape[2]) * scale,
        mapping="incremental",
        threads=threads,
        given=matcher != "sift",
    )


def plausible(model: ColmapModel) -> bool:
    """Whether the focal lengths are those of real lenses."""
    fov = [np.degrees(2 * np.arctan(c.width / 2 / c.K[0, 0])) for c in model.cameras.values()]
    return all(FOV[0] <= f <= FOV[1] for f in fov)


def worth(model: ColmapModel, count: int) -> tuple[bool, bool, int, int]:
    """What makes one reconstruction better than another: a plausible lens, enough
    images, then more images, then more long tracks.
    """
    return (
        plausible(model),
        len(model.images) >= ENOUGH * count,
        len(model.images),
        int((model.track_lengths >= 3).sum()),
    )


def sentence(model: ColmapModel | None, views: Views, failures: list[str]) -> str:
    """Why there are no poses, for which frames, and what to do."""
    count = len(views.of_frame)
    if model is None:
        why = f"; the last error was: {failures[-1]}" if failures else ""
        return f"poses failed: no two frames could be tied together (no common texture seen from two places){why}; {ADVICE}"
    have = {int(i.name[:5]) for i in model.images.values()}
    missing = [t for t in range(count) if int(views.of_frame[t]) not in have]
    if len(missing) <= (1 - LEAST) * count:
        focal = next(iter(model.cameras.values())).K[0, 0] / upsampling(views.pictures.shape[2])
        return f"poses failed: the focal length came out at an impossible {focal:.0f} px for {views.pictures.shape[2]} px wide frames; {ADVICE}"
    return f"poses failed: {len(missing)} of {count} frames could not be placed (frames {ranges(missing)}); {ADVICE}"


def assemble(model: ColmapModel, views: Views, scale: int, size: tuple[int, int]) -> Poses:
    """Poses of all frames from a reconstruction of the views, in a world of our own:
    mean camera at the origin, near 1.
    """
    count, (height, width) = len(views.of_frame), size
    image_of = {int(i.name[:5]): i for i in model.images.values()}
    registered = np.array([int(v) in image_of for v in views.of_frame])
    c2w = np.tile(np.eye(4)[:3], (count, 1, 1))
    K = np.zeros((count, 3, 3))
    for group in views.groups:
        focals = {
            model.cameras[image_of[v].camera_id].K[0, 0] / scale for v in group if v in image_of
        }
        if not focals:
            raise InputError(
                f"poses failed: none of the frames of one camera could be placed (views {ranges(group)}); {ADVICE}"
            )
        K[np.isin(views.of_frame, group)] = intrinsics(focals.pop(), width, height)
    for t in np.flatnonzero(registered):
        c2w[t] = image_of[int(views.of_frame[t])].c2w
    tracks = gather_tracks(model, views, scale)
    poses = Poses(K, c2w, registered, "full", model.points, model.errors / scale, tracks)
    poses = trusted_points(poses)
    poses = interpolate(
        centered(poses), [list(np.flatnonzero(np.isin(views.of_frame, g))) for g in views.groups]
    )
    return replace(poses, notes=(*poses.notes, summary(poses)))


def gather_tracks(model: ColmapModel, views: Views, scale: int) -> np.ndarray:
    """All observations (O, 4): frame, row of the point, x, y in pixels of the frames. A
    view shared by many frames counts for its first.
    """
    row = {int(key): r for r, key in enumerate(model.point_ids)}
    first = {int(v): t for t, v in reversed(list(enumerate(views.of_frame)))}
    seen = []
    for image in model.images.values():
        frame = first[int(image.name[:5])]
        seen += [
            (frame, row[int(p)], *(xy / scale))
            for xy, p in zip(image.xy, image.point_ids, strict=True)
            if p >= 0
        ]
    return np.array(seen, np.float64).reshape(-1, 4)


def centered(poses: Poses) -> Poses:
    """The same cameras and points with the mean registered camera at the origin looking
    along +z, scaled so that near is 1.
    """
    if len(poses.points) < 10:
        raise InputError(
            f"poses failed: only {len(poses.points)} static points could be placed; {ADVICE}"
        )
    placed = poses.c2w[poses.registered]
    turn = Rotation.from_matrix(placed[:, :, :3]).mean().as_matrix()
    center = placed[:, :, 3].mean(0)
    depth = project(
        poses, poses.tracks[:, 0].astype(int), poses.points[poses.tracks[:, 1].astype(int)]
    )[1]
    near, far = 0.7 * np.percentile(depth, 1), 1.3 * np.percentile(depth, 99)
    moved = (poses.c2w[:, :, 3] - center) @ turn / near
    c2w = np.concatenate([turn.T @ poses.c2w[:, :, :3], moved[:, :, None]], 2)
    return replace(
        poses,
        c2w=c2w,
        points=(poses.points - center) @ turn / near,
        near=1.0,
        far=float(far / near),
    )


def summary(poses: Poses) -> str:
    """One sentence: frames, points, focal length, errors."""
    focal = poses.K[:, 0, 0]
    fov = np.degrees(2 * np.arctan(poses.K[:, 0, 2] / focal))
    several = "" if np.ptp(focal) < 1e-6 else f" to {focal.max():.0f}"
    return (
        f"{int(poses.registered.sum())} of {len(focal)} frames registered, {len(poses.points)} static points, focal length "
        f"{focal.min():.0f}{several} px ({fov.max():.0f} degrees across), median reprojection error {np.nanmedian(poses.frame_errors):.2f} px"
    )
