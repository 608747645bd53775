"""`hdr-nsff reexpose`: an alternating-exposure problem made of any ordinary clip, whose
truth is the clip itself.

The clip is linearized (gamma 2.2) and taken for the scene's radiance. A camera with
another response records it again with alternating exposures, noise and 8 bits. The
output folder holds `clip/` (the footage), `truth/` (radiance of the held-out frames,
for `evaluate`), `transforms.json` (where poses are given: those of the footage, for
`prepare --poses`) and `reexpose.json` (the settings).

With poses, held-out frames are missing from the footage, and their time lies between
their neighbors'. Without poses, the place of a missing frame's camera would be unknown,
so they stay in the footage, and `prepare --hold-out` or `run --truth` keeps them out of
training.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from tyro.conf import Positional

from hdr_nsff.core.errors import InputError, check_number
from hdr_nsff.core.exr import write_exr
from hdr_nsff.core.hashes import hash_file
from hdr_nsff.core.hdr_video import Codec
from hdr_nsff.core.images import read_mask, write_png
from hdr_nsff.core.io import holds_nothing, read_json, write_json, writing_to
from hdr_nsff.core.lock import lock_output
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage.bars import with_bars
from hdr_nsff.footage.exposure_lists import parse_exposures
from hdr_nsff.footage.footage import FOLDER_FPS, MAX_RATE_DIFFERENCE, Footage, open_footage
from hdr_nsff.footage.frame_choice import check_choice, check_frame_size, no_frame
from hdr_nsff.footage.frame_files import frame_files
from hdr_nsff.footage.hold_out import HOLD_OUT, hold_out_every
from hdr_nsff.footage.ingest import FootageFrame, read_frames
from hdr_nsff.footage.layouts.nerfstudio import pose_entry
from hdr_nsff.footage.pose_files import import_poses
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.maths.hdr_signal import Transfer
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.radiometry.hdr_references import (
    ReferenceKinds,
    check_references,
    write_references,
)
from hdr_nsff.radiometry.hdr_stills import HdrStill
from hdr_nsff.radiometry.recording import Curve, record, response_curve
from hdr_nsff.scene.truth import Truth, TruthView
from hdr_nsff.synth.auto_exposure import auto_exposure, exposure_jumps
from hdr_nsff.synth.settings import MAX_NOISE, sensor_noise

MAX_SEED = 2**63


@dataclass(frozen=True)
class ReexposeConfig:
    """Make an alternating-exposure problem, with its truth kept aside, of any ordinary
    clip.
    """

    clip: Positional[Path]
    """Footage: a video, or a folder of frames of one camera."""
    out: Positional[Path]
    """Folder to write `clip/` and `truth/` to."""
    ev: str = "-2,0,2"
    """log2 exposures of one cycle; 0 records white of the clip as white."""
    exposure: Literal["fixed", "auto", "steps"] = "fixed"
    """fixed: every frame has an exposure of the cycle; auto: all of them drift on top,
    as with auto exposure (`--ev 0`: nothing but the drift); steps: the same, with a
    jump of one stop now and then.
    """
    noise: float = 1.0
    """Sensor noise: 1 is a small sensor of 6000 electrons, 0 none."""
    response: str = "film"
    """The camera that records: film (an S-curve, every channel its own), log, gamma or
    srgb.
    """
    hdr_video: tuple[Transfer, ...] = ()
    """Also write the linearized clip as 10-bit HDR video, reference_hlg.mp4 and
    reference_pq.mp4: hlg, pq or both. Its white is diffuse white.
    """
    hdr_codec: Codec = "hevc"
    """Of these videos: hevc, av1 or prores (4444, MOV), as `render` has it."""
    hdr_still: tuple[HdrStill, ...] = ()
    """Also write its frames as HDR stills into reference/: ultrahdr (JPEG with a gain
    map), avif, png16 (both PQ).
    """
    hold_out: int = HOLD_OUT
    """Spacing of the frames that are held out as truth."""
    poses: Path | None = None
    """Camera poses of all frames of the clip: COLMAP model folder, transforms.json,
    poses_bounds.npy, precomputed.json.
    """
    masks: Path | None = None
    """Folder of moving masks of all frames of the clip, in order, moving = white:
    `evaluate` then scores moving pixels too.
    """
    max_size: int = 640
    """Longest side in pixels; larger frames are shrunk."""
    start: int = 0
    """First frame to use, counted from 0."""
    end: int | None = None
    """Frame to stop before."""
    stride: int = 1
    """Spacing of the frames to use; 1 uses all."""
    seed: int = 0
    """Seed of the noise."""


GAMMA = 2.2  # by which the clip is linearized
MIN_FRAMES = 3  # of the footage


@dataclass(frozen=True)
class FramePlan:
    """The role of every frame of the chosen footage."""

    bracket: list[int]  # per frame: its place in the cycle, also of frames left out
    test: list[int]  # frames that are the truth
    kept: list[int]  # frames of the new footage

    def time(self, frame: int) -> float:
        """The time of a frame in frames of the new footage; half-way between its
        neighbors where it is missing from it.
        """
        before = sum(k < frame for k in self.kept)
        return float(before) if frame in self.kept else before - 0.5

    def anchor(self, frame: int) -> int:
        """The position in the new footage nearest to a frame."""
        return int(np.argmin([abs(k - frame) for k in self.kept]))


def reexpose(config: ReexposeConfig) -> Path:
    """Write the new footage and its truth; the output folder. A killed run continues
    where it was.
    """
    with writing_to(config.out), lock_output(config.out):
        evs = check(config)
        response = response_curve(config.response)
        footage = open_footage(config.clip)
        if len(footage.cameras) > 1:
            raise InputError(
                f"{config.clip}: {len(footage.cameras)} cameras; "
                "re-expose one camera's folder at a time"
            )
        if config.poses is None and config.masks is None:
            footage = with_bars(footage)
        if footage.bars:
            say(footage.bars.sentence())
        if footage.interlaced:
            say(footage.interlacing())
        numbers, extents, size = look_through(config, footage)
        if not numbers:
            raise InputError(no_frame(config.clip, config.start, footage.count))
        fps = footage.fps / config.stride
        check_references(config.clip, (size[1], size[0]), fps, reference_kinds(config))
        plan = plan_frames(len(numbers), len(evs), config.hold_out, config.poses is not None)
        poses = None if config.poses is None else read_poses(config.poses, footage, numbers, size)
        color = exposure.all_clipped(extents)
        if color is not None:
            raise InputError(
                f"{config.clip}: all frames are {color}, and re-exposing does not change that; "
                "choose another clip"
            )
        masks = {}
        if config.masks is not None:
            masks = frame_masks(config.masks, plan.test, numbers, size)
        drift, jumps = frame_drift(config, plan)
        claim(config, footage, jumps)  # once nothing can be wrong with the settings any more
        write_frames(config, footage, plan, evs, drift, response)
        write_truth(config.out, plan, evs, drift, response, poses, masks)
        write_linearized(config, footage, len(numbers))
        given = f"--hold-out {config.hold_out}"
        if poses is not None:
            path = config.out / "transforms.json"
            write_poses(path, poses, size, plan.kept)
            given = f"--poses {path} --hold-out 0"
    say(
        f"{len(plan.kept)} frames in {config.out / 'clip'}, "
        f"{len(plan.test)} true views in {config.out / 'truth'}"
    )
    say_rate(fps)
    say(f"next: hdr-nsff prepare {config.out / 'clip'} SCENE --ev={config.ev} {given}")
    return config.out


def say_rate(fps: float) -> None:
    """One sentence where the new footage, a folder of frames, has lost its rate."""
    if abs(fps - FOLDER_FPS) > MAX_RATE_DIFFERENCE * fps:
        say(
            f"{fps:.4g} frames a second are now {FOLDER_FPS:g}, as in any folder of frames: "
            f"`render --fps {fps:.4g}` plays as fast as the clip, and `--segment` and "
            "`--readout` count seconds at the new rate"
        )


def check(config: ReexposeConfig) -> list[float]:
    """The exposures of a cycle, log2. InputError for settings that make no sense
    whatever the footage is.
    """
    evs = parse_exposures(None, config.ev)
    if evs is None:
        raise InputError(
            "--ev auto: there is nothing to detect; list the log2 exposures of one cycle, "
            "like -2,0,2"
        )
    check_choice(config.start, config.end, config.stride, config.max_size, config.hold_out)
    check_number("--noise", config.noise, 0, MAX_NOISE)
    check_number("--seed", config.seed, 0, MAX_SEED)
    return evs


def look_through(
    config: ReexposeConfig, footage: Footage
) -> tuple[list[int], list[tuple[float, float]], tuple[int, int]]:
    """The numbers of the chosen frames in the footage, the extents of their values, and
    their size (H, W).
    """
    numbers, extents = [], []
    size = (0, 0)
    for frame in track(chosen(config, footage), "reading"):
        numbers.append(frame.number)
        extents.append(exposure.extent(frame.rgb))
        size = (frame.rgb.shape[0], frame.rgb.shape[1])
        check_frame_size(config.clip, size[1], size[0])
    return numbers, extents, size


def chosen(config: ReexposeConfig, footage: Footage) -> Iterator[FootageFrame]:
    """The frames to use."""
    return read_frames(footage, config.start, config.end, config.stride, config.max_size)


def claim(config: ReexposeConfig, footage: Footage, jumps: Mapping[int, float]) -> None:
    """Write `reexpose.json`, with the `jumps` of auto exposure in stops by the frame
    from which on they hold; InputError where the output holds something else.
    """
    settings: dict[str, Any] = {"clip": str(config.clip)}
    for name, value in asdict(config).items():
        if name not in ("clip", "out", "hdr_video", "hdr_codec", "hdr_still"):
            settings[name] = str(value) if isinstance(value, Path) else value
    if jumps:
        settings["jumps"] = {str(frame): ev for frame, ev in jumps.items()}
    settings["inputs"] = {name: hash_file(file) for name, file in footage.files.items()}
    path = config.out / "reexpose.json"
    if path.is_file():
        if not same_problem(path, settings):
            raise InputError(
                f"{config.out}: holds another clip, or one made with other settings; "
                "choose another folder"
            )
    elif config.out.exists() and not holds_nothing(config.out):
        raise InputError(
            f"{config.out}: already exists and was not made by reexpose; "
            "choose an empty or new folder"
        )
    write_json(path, settings)


def same_problem(path: Path, settings: dict[str, Any]) -> bool:
    """Whether an earlier `reexpose.json` is of the same frames and settings, wherever
    the clip lay.
    """
    try:
        return {**read_json(path), "clip": ""} == {**settings, "clip": ""}
    except (ValueError, TypeError):
        return False


def plan_frames(count: int, cycle: int, hold_out: int, remove: bool) -> FramePlan:
    """Which of `count` frames are recorded, in which bracket, and which are the truth;
    with `remove`, those are missing from the footage. InputError where too few remain.

    The cycle runs over the recorded frames without a break.
    """
    test = hold_out_every(count, hold_out, cycle, removed=remove)
    missing = set(test) if remove else set()
    kept = [k for k in range(count) if k not in missing]
    if len(kept) < MIN_FRAMES:
        frames = "1 frame" if len(kept) == 1 else f"{len(kept)} frames"
        raise InputError(
            f"{frames} left for the footage; at least {MIN_FRAMES} are needed, "
            "so give a longer clip, or another --hold-out, --start, --end or --stride"
        )
    bracket = [sum(j < k for j in kept) % cycle for k in range(count)]
    return FramePlan(bracket, test, kept)


def frame_drift(config: ReexposeConfig, plan: FramePlan) -> tuple[np.ndarray, dict[int, float]]:
    """EV by which every frame (T,) leaves its bracket, and the jumps in it."""
    count = len(plan.bracket)
    if config.exposure == "fixed":
        return np.zeros(count), {}
    jumps = exposure_jumps(count, config.seed) if config.exposure == "steps" else {}
    return auto_exposure(count, plan.kept, config.seed, jumps), jumps


def write_frames(
    config: ReexposeConfig,
    footage: Footage,
    plan: FramePlan,
    evs: list[float],
    drift: np.ndarray,
    response: Curve,
) -> None:
    """Write the recorded frames and the radiance of the held-out ones, as far as they
    are not there yet.
    """
    noise = sensor_noise(config.noise)
    places = {k: place for place, k in enumerate(plan.kept)}
    white_balance = (1, 1, 1)
    for k, frame in enumerate(track(chosen(config, footage), "frames", len(plan.bracket))):
        radiance = frame.rgb.astype(np.float64) ** GAMMA
        if k in places:
            image = config.out / f"clip/{places[k]:05d}.png"
            if not image.is_file():
                rng = np.random.default_rng([config.seed, k])
                ev = evs[plan.bracket[k]] + drift[k]
                write_png(image, record(radiance, ev, white_balance, response, noise, rng))
        if k in plan.test:
            exr = config.out / f"truth/radiance/{k:05d}.exr"
            if not exr.is_file():
                write_exr(exr, {"RGB": radiance.astype(np.float32)})


def write_linearized(config: ReexposeConfig, footage: Footage, num_frames: int) -> None:
    """Write the linearized clip as the HDR references that are asked for."""

    def radiance() -> Iterator[np.ndarray]:
        return (frame.rgb.astype(np.float64) ** GAMMA for frame in chosen(config, footage))

    fps = footage.fps / config.stride
    write_references(config.out, radiance, num_frames, fps, 1.0, reference_kinds(config))


def reference_kinds(config: ReexposeConfig) -> ReferenceKinds:
    """The HDR references that are asked for."""
    return ReferenceKinds(config.hdr_video, config.hdr_codec, config.hdr_still)


def write_truth(
    out: Path,
    plan: FramePlan,
    evs: list[float],
    drift: np.ndarray,
    response: Curve,
    poses: Poses | None,
    masks: dict[int, np.ndarray],
) -> None:
    """Write `truth.json` with the masks (H, W) bool that it names, by frame."""
    for k, mask in masks.items():
        write_png(out / f"truth/masks/{k:05d}.png", mask)
    K = poses.K[0].tolist() if poses is not None else None
    c2w = poses.c2w.tolist() if poses is not None else None
    views = [
        TruthView(
            name=f"{k:05d}",
            time=plan.time(k),
            bracket=plan.bracket[k],
            anchor=plan.anchor(k),
            c2w=c2w[k] if c2w else None,
            K=own_intrinsics(poses, k, plan.kept[plan.anchor(k)]),
            radiance=f"radiance/{k:05d}.exr",
            mask=f"masks/{k:05d}.png" if k in masks else None,
        )
        for k in plan.test
    ]
    truth = Truth(
        bracket_ev=evs,
        reference_bracket=int(np.argmin(np.abs(evs))),
        response_x=response.x.tolist(),
        response_y=response.y.tolist(),
        K=K,
        clip_c2w=[c2w[k] for k in plan.kept] if c2w else None,
        clip_drift=drift[plan.kept].tolist() if drift.any() else None,
        views=views,
    )
    write_json(out / "truth/truth.json", truth.model_dump())


def own_intrinsics(poses: Poses | None, frame: int, anchor: int) -> list[list[float]] | None:
    """K (3, 3) of a frame; None where it is that of its anchor, or unknown."""
    if poses is None or np.allclose(poses.K[frame], poses.K[anchor]):
        return None
    return poses.K[frame].tolist()


def frame_masks(
    folder: Path, frames: list[int], numbers: list[int], size: tuple[int, int]
) -> dict[int, np.ndarray]:
    """The masks of `size` (H, W) bool of the held-out `frames`, from a folder with one
    image for every frame of the clip. `numbers` are the frames' places in the clip.
    """
    files = frame_files(folder) if folder.is_dir() else []
    needed = max(numbers) + 1
    if len(files) < needed:
        raise InputError(
            f"--masks {folder}: {len(files)} masks for a clip of at least {needed} frames; "
            "give one per frame, in order"
        )
    masks = {}
    for k in frames:
        file = files[numbers[k]]
        mask = read_mask(file)
        if mask.shape != size:
            raise InputError(
                f"--masks {file}: the mask is {mask.shape[1]}x{mask.shape[0]}, "
                f"the frames are {size[1]}x{size[0]}; make it that size"
            )
        masks[k] = mask
    return masks


def read_poses(path: Path, footage: Footage, numbers: list[int], size: tuple[int, int]) -> Poses:
    """The poses of the frames at places `numbers` of the clip, for frames of `size`
    (H, W).
    """
    names = list(footage.files)
    if footage.video:
        count = max(footage.count, max(numbers, default=0) + 1)
        names = [f"{footage.path.name}#{n}" for n in range(count)]
    given = import_poses(path, names, size)
    return replace(
        given, K=given.K[numbers], c2w=given.c2w[numbers], registered=given.registered[numbers]
    )


def write_poses(path: Path, poses: Poses, size: tuple[int, int], kept: list[int]) -> None:
    """Write the poses of the `kept` frames, of `size` (H, W), as a `transforms.json` of
    the new footage.
    """
    frames = [
        pose_entry(f"clip/{place:05d}.png", poses.K[k], poses.c2w[k], place / max(len(kept) - 1, 1))
        for place, k in enumerate(kept)
    ]
    height, width = size
    bounds = {"near": poses.near, "far": poses.far}
    write_json(path, {"w": width, "h": height, **bounds, "frames": frames})
