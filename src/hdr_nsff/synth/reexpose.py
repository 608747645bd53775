"""Any ordinary clip -> an alternating-exposure problem whose truth is the clip itself.

The clip is linearized (gamma 2.2) and taken for the scene's radiance; a camera with
another response records it again with alternating exposures, noise and 8 bits. Into
`OUT`: `clip/` (the footage), `truth/` (radiance of the held-out frames, for
`evaluate`), `poses_bounds.npy` (where poses are given: those of the footage, for
`prepare --poses`), `reexpose.json` (what was done).

With poses, held-out frames are missing from the footage, and their time lies between
their neighbors'. Without, nobody could say where a missing frame was seen from, so they
stay in the footage and `prepare --hold-out`, or `run --truth`, keeps them out of
training.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from tyro.conf import Positional

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.io import (
    read_json,
    read_mask,
    write_exr,
    write_json,
    write_npy,
    write_png,
    writing_to,
)
from hdr_nsff.core.progress import say, track
from hdr_nsff.footage import ingest
from hdr_nsff.footage.exposure_lists import parse_exposures
from hdr_nsff.footage.pose_files import import_poses
from hdr_nsff.geometry.poses import Poses
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.radiometry.recording import Curve, Noise, record, response_curve
from hdr_nsff.scene.truth import Truth, TruthView

MAX_NOISE = 100.0  # times that of a small sensor: nothing is left of the picture
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
    noise: float = 1.0
    """Sensor noise: 1 is a small sensor of 6000 electrons, 0 none."""
    response: str = "film"
    """The camera that records: film (an S-curve, every channel its own), log, gamma or
    srgb.
    """
    hold_out: int = ingest.HOLD_OUT
    """Every this many frames are the truth."""
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
    """Use every this many frames."""
    seed: int = 0
    """Seed of the noise."""


@dataclass(frozen=True)
class Plan:
    """Which frame becomes what. `N` frames of the chosen footage."""

    bracket: list[int]  # per frame: its place in the cycle, as recorded or as it would have been
    test: list[int]  # frames that are the truth
    kept: list[int]  # frames of the new footage

    def time(self, frame: int) -> float:
        """The time of a frame in frames of the new footage; half-way where it is
        missing from it.
        """
        before = sum(k < frame for k in self.kept)
        return float(before) if frame in self.kept else before - 0.5

    def anchor(self, frame: int) -> int:
        """The position in the new footage nearest to a frame."""
        return int(np.argmin([abs(k - frame) for k in self.kept]))


def reexpose(config: ReexposeConfig) -> Path:
    """Write the new footage and its truth; the output folder. A killed run goes on
    where it was.
    """
    with writing_to(config.out):
        ingest.check_choice(
            config.start, config.end, config.stride, config.max_size, config.hold_out
        )
        ingest.check_number("--noise", config.noise, 0, MAX_NOISE)
        ingest.check_number("--seed", config.seed, 0, MAX_SEED)
        evs = parse_exposures(None, config.ev)
        if evs is None:
            raise InputError(
                "--ev auto: nothing to find here; list the log2 exposures of one cycle, like -2,0,2"
            )
        footage = ingest.open_footage(config.clip)
        if len(footage.cameras) > 1:
            raise InputError(
                f"{config.clip}: {len(footage.cameras)} cameras; re-expose one camera's folder at a time"
            )
        response = response_curve(config.response)
        numbers, extents, size = [], [], (0, 0)
        for frame in track(chosen(config, footage), "reading"):
            numbers.append(frame.number)
            extents.append(exposure.extent(frame.rgb))
            size = (frame.rgb.shape[0], frame.rgb.shape[1])
            ingest.check_frame_size(config.clip, size[1], size[0])
        work = plan(len(numbers), len(evs), config.hold_out, remove=config.poses is not None)
        poses = (
            read_poses(config.poses, footage, numbers, size) if config.poses is not None else None
        )
        if (color := exposure.all_clipped(extents)) is not None:
            raise InputError(
                f"{config.clip}: all frames are {color}; re-exposed they stay so, choose another clip"
            )
        masks = (
            frame_masks(config.masks, work.test, numbers, size) if config.masks is not None else {}
        )
        claim(config, footage)  # once nothing can be wrong with the settings any more
        write_frames(config, footage, work, evs, response)
        write_truth(config.out, work, evs, response, poses, masks)
        if poses is not None:
            write_npy(config.out / "poses_bounds.npy", llff_rows(poses, size)[work.kept])
    say(
        f"{len(work.kept)} frames in {config.out / 'clip'}, {len(work.test)} true views in {config.out / 'truth'}"
    )
    given = (
        f"--poses {config.out / 'poses_bounds.npy'} --hold-out 0"
        if poses
        else f"--hold-out {config.hold_out}"
    )
    say(f"next: hdr-nsff prepare {config.out / 'clip'} SCENE --ev={config.ev} {given}")
    return config.out


def chosen(config: ReexposeConfig, footage: ingest.Footage) -> Iterator[ingest.FootageFrame]:
    """The frames to use."""
    return ingest.read_frames(footage, config.start, config.end, config.stride, config.max_size)


def claim(config: ReexposeConfig, footage: ingest.Footage) -> None:
    """Write `reexpose.json`; InputError where the output folder holds something else."""
    given = {
        name: str(value) if isinstance(value, Path) else value
        for name, value in asdict(config).items()
        if name not in ("clip", "out")
    }
    told = {
        "clip": str(config.clip),
        **given,
        "inputs": {n: ingest.hash_file(f) for n, f in footage.files.items()},
    }
    path = config.out / "reexpose.json"
    if path.is_file():
        try:
            same = {**read_json(path), "clip": ""} == {**told, "clip": ""}
        except (ValueError, TypeError):
            same = False
        if not same:
            raise InputError(
                f"{config.out}: holds another clip, or one made with other settings; choose another folder"
            )
    elif config.out.exists() and (
        not config.out.is_dir()
        or any(not p.name.startswith(".partial-") for p in config.out.iterdir())
    ):
        raise InputError(
            f"{config.out}: is there already and was not made by reexpose; choose an empty or new folder"
        )
    write_json(path, told)


def plan(count: int, cycle: int, hold_out: int, remove: bool) -> Plan:
    """Which of `count` frames are recorded, in which bracket, and which are the truth;
    those missing from the footage if `remove`.

    The cycle runs over the recorded frames without a break.
    """
    test = ingest.held_out(count, hold_out, cycle)
    kept = [k for k in range(count) if not (remove and k in test)]
    if len(kept) < 3:
        raise InputError(
            f"{len(kept)} frame{'s' * (len(kept) != 1)} left for the footage; at least 3 are needed, so give a longer clip or another --hold-out"
        )
    bracket = [sum(j < k for j in kept) % cycle for k in range(count)]
    return Plan(bracket, test, kept)


def write_frames(
    config: ReexposeConfig, footage: ingest.Footage, work: Plan, evs: list[float], response: Curve
) -> None:
    """Write the recorded frames and the radiance of the held-out ones, those not there
    yet.
    """
    noise = Noise(1e-3 * config.noise, config.noise**2 / 6000) if config.noise else None
    total = len(work.bracket)
    for k, frame in enumerate(track(chosen(config, footage), "frames", total)):
        radiance = frame.rgb.astype(np.float64) ** 2.2
        if (
            k in work.kept
            and not (image := config.out / f"clip/{work.kept.index(k):05d}.png").is_file()
        ):
            rng = np.random.default_rng([config.seed, k])
            write_png(
                image, record(radiance, evs[work.bracket[k]], (1, 1, 1), response, noise, rng)
            )
        if k in work.test and not (exr := config.out / f"truth/radiance/{k:05d}.exr").is_file():
            write_exr(exr, {"RGB": radiance.astype(np.float32)})


def write_truth(
    out: Path,
    work: Plan,
    evs: list[float],
    response: Curve,
    poses: Poses | None,
    masks: dict[int, np.ndarray],
) -> None:
    """Write `truth.json` with the masks it names."""
    for k, mask in masks.items():
        write_png(out / f"truth/masks/{k:05d}.png", mask)
    c2w = poses.c2w.tolist() if poses is not None else None
    views = [
        TruthView(
            name=f"{k:05d}",
            time=work.time(k),
            bracket=work.bracket[k],
            anchor=work.anchor(k),
            c2w=c2w[k] if c2w else None,
            radiance=f"radiance/{k:05d}.exr",
            mask=f"masks/{k:05d}.png" if k in masks else None,
        )
        for k in work.test
    ]
    truth = Truth(
        bracket_ev=evs,
        reference_bracket=int(np.argmin(np.abs(evs))),
        response_x=response.x.tolist(),
        response_y=response.y.tolist(),
        K=poses.K[0].tolist() if poses is not None else None,
        clip_c2w=[c2w[k] for k in work.kept] if c2w else None,
        views=views,
    )
    write_json(out / "truth/truth.json", truth.model_dump())


def frame_masks(
    folder: Path, frames: list[int], numbers: list[int], size: tuple[int, int]
) -> dict[int, np.ndarray]:
    """The masks of `size` (H, W) bool of the held-out `frames`, from a folder with one
    image for every frame of the clip.
    """
    files = ingest.frame_files(folder) if folder.is_dir() else []
    if len(files) <= max(numbers):
        raise InputError(
            f"--masks {folder}: {len(files)} masks for a clip of at least {max(numbers) + 1} frames; one per frame, in order"
        )
    masks = {k: read_mask(files[numbers[k]]) for k in frames}
    for k, mask in masks.items():
        if mask.shape != size:
            raise InputError(
                f"{files[numbers[k]]}: the mask is {mask.shape[1]}x{mask.shape[0]}, the frames are {size[1]}x{size[0]}; make it that size"
            )
    return masks


def read_poses(
    path: Path, footage: ingest.Footage, numbers: list[int], size: tuple[int, int]
) -> Poses:
    """The poses of frames `numbers` of the clip, for frames of `size` (height, width)."""
    names = list(footage.files)
    if footage.video:
        names = [
            f"{footage.path.name}#{n}"
            for n in range(max(footage.count, max(numbers, default=0) + 1))
        ]
    given = import_poses(path, names, size)
    return replace(
        given, K=given.K[numbers], c2w=given.c2w[numbers], registered=given.registered[numbers]
    )


def llff_rows(poses: Poses, size: tuple[int, int]) -> np.ndarray:
    """(N, 17) as in poses_bounds.npy: 3x5 (columns down, right, back, center, (height,
    width, focal)), then near and far (0: unknown).
    """
    c = poses.c2w
    last = np.stack([np.full(len(c), size[0]), np.full(len(c), size[1]), poses.K[:, 0, 0]], -1)
    matrices = np.stack([c[..., 1], c[..., 0], -c[..., 2], c[..., 3], last], -1)  # (N, 3, 5)
    return np.concatenate(
        [matrices.reshape(-1, 15), np.tile([poses.near or 0.0, poses.far or 0.0], (len(c), 1))], 1
    )
