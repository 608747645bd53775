"""The views that a public data set holds out for testing, layout by layout: their
files, times, exposures and poses. No picture is opened here; `held_out.py` does that.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from hdr_nsff.core.errors import InputError
from hdr_nsff.footage.datasets import (
    blender,
    hdr_nerf,
    hdr_nerf_real,
    layout_of,
    llff,
    nerfstudio,
)
from hdr_nsff.footage.datasets.capture import Capture, Clock, select_poses
from hdr_nsff.footage.datasets.extra import Extra, parse_extra
from hdr_nsff.footage.datasets.set_files import map_file, picture_file, read_document
from hdr_nsff.footage.pose_formats import GivenPoses, from_transforms

# stored EV, or training pictures that are exposed like it, or unknown
Exposure = float | list[str] | None


@dataclass(frozen=True)
class HeldOut:
    """One view that a data set holds out."""

    name: str
    time: float | None  # in frames of the set; None: nothing moves
    recorded: list[tuple[Path, Exposure]]  # pictures of it
    radiance: Path | None = None
    mask: Path | None = None
    anchor: str | None = None  # the training picture whose pose it has exactly


def read_views(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """The held-out views of a set, and their poses, row by row.

    InputError where something is missing or short.
    """
    readers = {
        "nerfstudio": nerfstudio_views,
        "hdr-nerf": hdr_nerf_views,
        "hdr-nerf-real": hdr_nerf_real_views,
        "blender": blender_views,
        "hdr-gopro": llff_views,
    }
    name = layout_of(capture.root)
    assert name is not None, capture.root
    return readers[name](capture)


def training_poses(capture: Capture) -> GivenPoses:
    """The poses of the training pictures."""
    assert capture.poses is not None, "every layout with held-out views has poses"
    return capture.poses


# Blender


def blender_views(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """The views of `transforms_test.json`; radiance where `exr_file_path` names it."""
    root = capture.root
    path = root / blender.TEST
    training = root / blender.TRAIN
    trained = read_document(training, "the training pictures and their poses")["frames"]
    kind = blender.layout_name(trained)
    clock = Clock.of(blender.stored_times(training, trained))
    document = read_document(path, "the held-out views and their poses")
    frames = document["frames"]
    times = blender.stored_times(path, frames)
    views = []
    for number, (frame, time) in enumerate(zip(frames, times, strict=True)):
        purpose = f"held-out view {number} of {blender.TEST}"
        file = picture_file(root, frame["file_path"], purpose)
        exposure: Exposure = blender.exposure_of(path, frame, kind)
        if exposure is None:
            exposure = [p.source for p in capture.pictures]
        radiance = None
        if isinstance(frame.get("exr_file_path"), str):
            purpose = f"the radiance of held-out view {number}"
            radiance = picture_file(root, frame["exr_file_path"], purpose)
        view_time = None if capture.is_static else clock(time)
        views.append(HeldOut(f"{number:04d}", view_time, [(file, exposure)], radiance))
    return views, from_transforms(path, document)


# HDR-NeRF


def hdr_nerf_views(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """All five exposures of every test view, and its radiance where that is there.

    The radiance is `test_hdr/hdr_<number>.exr`.
    """
    root = capture.root
    path = root / blender.TEST
    document = read_document(path, "the held-out views and their poses")
    times = hdr_nerf.exposure_times(root, "test")
    views = []
    for number, frame in enumerate(document["frames"]):
        pictures: list[tuple[Path, Exposure]] = []
        for which in range(hdr_nerf.NUM_EXPOSURES):
            purpose = f"exposure {which} of held-out view {number}"
            file = picture_file(root, hdr_nerf.picture_name(frame, which), purpose)
            pictures.append((file, hdr_nerf.ev_of(root, "test", times, frame, which)))
        exr = root / "test_hdr" / f"hdr_{number:03d}.exr"
        radiance = exr if exr.is_file() else None
        views.append(HeldOut(f"{number:04d}", None, pictures, radiance))
    return views, from_transforms(path, document)


def hdr_nerf_real_views(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """All five exposures of every second pose."""
    files, given, ev = hdr_nerf_real.read_cameras(capture.root)
    views = []
    first_rows = []
    for number, rows in enumerate(hdr_nerf_real.held_out_rows(len(ev))):
        pictures: list[tuple[Path, Exposure]] = [(files[row], ev[row]) for row in rows]
        views.append(HeldOut(f"{number:04d}", None, pictures))
        first_rows.append(rows[0])
    return views, select_poses(given, first_rows)


# nerfstudio


def nerfstudio_views(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """The frames that `val_filenames` and `test_filenames` list."""
    root = capture.root
    path = root / nerfstudio.NAME
    document = read_document(path, "the pictures and their poses")
    outside = nerfstudio.held_out_names(path, document)
    names = [frame["file_path"] for frame in document["frames"]]
    kept = [k for k, name in enumerate(names) if name in outside]
    times = nerfstudio.stored_times(path, document["frames"])
    clock = Clock.of([t for t, name in zip(times, names, strict=True) if name not in outside])
    extra = None
    if nerfstudio.EXTRA in document:
        extra = parse_extra(path, document[nerfstudio.EXTRA], names)
    views = []
    for k in kept:
        if extra is None:
            file = picture_file(root, names[k], f"a held-out view of {nerfstudio.NAME}")
            views.append(HeldOut(plain_name(names[k]), clock(times[k]), [(file, None)]))
        else:
            views.append(exported_view(capture, names[k], extra))
    return views, select_poses(from_transforms(path, document), kept)


def exported_view(capture: Capture, name: str, extra: Extra) -> HeldOut:
    """A held-out view as `export` wrote it into nerfstudio's layout."""
    own = extra.frames[name]
    file = picture_file(capture.root, name, f"a held-out view of {nerfstudio.NAME}")
    same_exposure: Exposure = [p.source for p in capture.pictures if p.bracket == own.bracket]
    mask = None
    if own.moving is not None:
        purpose = f"the moving mask of held-out view {plain_name(name)}"
        mask = map_file(capture.root, own.moving, purpose)
    return HeldOut(plain_name(name), own.time, [(file, same_exposure)], mask=mask)


def plain_name(name: str) -> str:
    """The name of a view from that of its picture, without folders and ending."""
    plain = Path(name.removeprefix(nerfstudio.VIEWS)).with_suffix("").as_posix()
    return re.sub(r"[^A-Za-z0-9._-]", "_", plain)


# HDR-GoPro


def llff_views(capture: Capture) -> tuple[list[HeldOut], GivenPoses]:
    """`mv_images/<time>/<camera>.png` of the cameras without a training picture then.

    Also `mv_images_time/`, half a frame later; masks in `mv_masks/` and
    `mv_masks_time/`. Of a set that `export` wrote, the ones that it noted.
    """
    dense = llff.dense_folder(capture.root)
    extra = llff.read_extra(dense, [Path(p.source).name for p in capture.pictures])
    if extra is not None and extra.held_out:
        return noted_views(capture, dense, extra)
    views = []
    rows = []
    for name, later in zip(llff.MULTI_VIEW, (0.0, 0.5), strict=True):
        folder = llff.multi_view(capture.root, name)
        if folder is None:
            continue
        masks = llff.multi_view(capture.root, name.replace("images", "masks"))
        steps = range(len(capture.pictures) - (1 if later else 0))
        cameras = count_cameras(folder, steps)
        for step in steps:
            for camera in range(cameras):
                if later or step % cameras != camera:  # else it is the training picture
                    view = llff_view(capture, folder, masks, step, camera, cameras)
                    views.append(view)
                    rows.append(camera)
    return views, select_poses(training_poses(capture), rows)


def noted_views(capture: Capture, dense: Path, extra: Extra) -> tuple[list[HeldOut], GivenPoses]:
    """The views that `export --truth` wrote below `dense`: some times, some cameras."""
    sources = {Path(p.source).name: p.source for p in capture.pictures}
    views = []
    rows = []
    for name, own in extra.held_out.items():
        same_exposure: Exposure = [p.source for p in capture.pictures if p.bracket == own.bracket]
        picture = picture_file(dense, name, f"held-out view {own.name}")
        mask = None
        if own.mask is not None:
            purpose = f"the moving mask of held-out view {own.name}"
            mask = picture_file(dense, own.mask, purpose)
        anchor = sources[own.anchor]
        views.append(
            HeldOut(own.name, own.time, [(picture, same_exposure)], mask=mask, anchor=anchor)
        )
        rows.append(capture.row[anchor])
    return views, select_poses(training_poses(capture), rows)


def count_cameras(folder: Path, steps: range) -> int:
    """The number of cameras; InputError where a time is missing."""
    counts = [0]
    for step in steps:
        place = folder / f"{step:05d}"
        if not place.is_dir():
            raise InputError(
                f"{place}: missing; it holds what every camera saw at time {step}, copy it again"
            )
        counts.append(len(list(place.glob("[0-9]*.png"))))
    return max(counts)


def llff_view(
    capture: Capture, folder: Path, masks: Path | None, step: int, camera: int, cameras: int
) -> HeldOut:
    """What `camera` (from 0) of `cameras` saw at `step`, in `mv_images/` or its like.

    Its pose is that of training picture `camera`, its exposure that of its own
    pictures.
    """
    name = f"{step:05d}/{camera + 1:05d}.png"
    if not (folder / name).is_file():
        raise InputError(
            f"{folder / name}: missing; it is what camera {camera + 1} saw at time {step}, "
            "copy it again"
        )
    mask = None
    if masks is not None:
        mask = masks / name
        if not mask.is_file():
            raise InputError(
                f"{mask}: missing; it is the moving mask of held-out view {folder.name}/{name}, "
                "copy it again"
            )
    pictures = capture.pictures
    if camera >= len(pictures):
        raise InputError(
            f"{folder / name}: camera {camera + 1} has no training picture and so no pose; "
            "copy the pictures again"
        )
    same_exposure: Exposure = [p.source for p in pictures[camera::cameras]]
    time = step + (0.5 if folder.name == llff.MULTI_VIEW[1] else 0.0)
    return HeldOut(
        f"t{time:07.1f}_camera{camera + 1}",
        time,
        [(folder / name, same_exposure)],
        mask=mask,
        anchor=pictures[camera].source,
    )
