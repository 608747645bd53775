"""The settings of `prepare`, and the unfinished scene folder that its steps share."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from tyro.conf import Positional, arg

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.images import codes_to_rgb, read_codes, read_mask
from hdr_nsff.core.io import read_npy
from hdr_nsff.core.stack import ArrayStack, RecentArrays, Stack
from hdr_nsff.footage.datasets.capture import Capture, Picture
from hdr_nsff.footage.footage import Footage
from hdr_nsff.priors.flow.semantic import SemanticConfig
from hdr_nsff.priors.flow.sources import FlowName
from hdr_nsff.priors.masks.visits import StaticPictures, separate_movers
from hdr_nsff.priors.poses.lightglue import Matcher
from hdr_nsff.priors.poses.mapper import Readout
from hdr_nsff.radiometry import exposure_cycle as exposure
from hdr_nsff.scene.manifest import FlowFiles, FrameEntry, Manifest, Protocol
from hdr_nsff.scene.posed_video import PosedVideo

MaskName = Literal["motion", "sam2"]
DepthName = Literal["geometric", "depth-anything"]
Part = Literal["poses", "flow", "masks", "depth"]
# flow (P, H, W, 2) float32 px, valid (P, H, W) bool, frame indices (P, 2) from and to
Flows = tuple[ArrayStack, ArrayStack, np.ndarray]
FLOW_MEMORY = 256 << 20  # the same of flow
FRAME_MEMORY = 384 << 20  # bytes of decoded frames that are kept; others are read again
StepName = Literal[
    "frames",
    "exposure",
    "flow",
    "poses",
    "masks",
    "static_depth",
    "response",
    "refined_flow",
    "movers",
    "depth",
    "sheet",
]


@dataclass(frozen=True)
class PrepareConfig:
    """Turn alternating-exposure footage into a scene folder.

    It holds exposures, poses, optical flow, moving masks and depth. Steps that are done
    are skipped, so the same command continues where a killed one was. Where the picture
    cuts, each part becomes a scene folder: OUT/part_00, OUT/part_01 and so on.
    """

    clip: Positional[Path]
    """Footage: a video, a folder of PNG, JPEG, TIFF, EXR or DNG frames, or a folder of
    such folders or videos, one per synchronized camera. Or a public data set: HDR-GoPro
    / NSFF (LLFF), D-NeRF, HDR-HexPlane, HDR-4D, HDR-NeRF, nerfstudio; what it gives is
    used.
    """
    out: Positional[Path]
    """Scene folder to write."""
    exposures: str | None = None
    """Exposure times of one cycle in seconds, in the order of the frames:
    1/1000,1/250,1/60. Default: a CSV beside the frames (`exposures.csv`, for a video
    `CLIP.csv`; columns file or frame, and exposure or ev), else EXIF or a GoPro's
    metadata, else found from brightness.
    """
    ev: str | None = None
    """The same as log2 exposures: -4,-2,0."""
    max_size: int = 640
    """Longest side of the frames in pixels; larger ones are shrunk."""
    start: int = 0
    """First frame to use, counted from 0."""
    end: int | None = None
    """Frame to stop before."""
    stride: int = 1
    """Use every STRIDE-th frame."""
    segment: float | None = None
    """Cut a long clip into scenes of SEGMENT seconds of video: OUT/segment_00,
    OUT/segment_01 and so on, each to be trained on its own. Neighbors overlap by an
    exposure cycle. All share the poses, the response and the exposures of the whole
    clip, and their times count its frames. Memory and time of training then follow
    SEGMENT and not the clip.
    """
    hold_out: int | None = None
    """Keep every N-th frame out of training, for `evaluate`; 0 keeps all in. Default
    8; 0 for a data set with held-out views.
    """
    protocol: Protocol | None = None
    """Split the clip as the published tables do, instead of --hold-out. novel-view:
    train on all frames, to be evaluated from other cameras at their times;
    novel-view-time: train on every second frame, to be evaluated at the times between.
    Either wants held-out views: a truth folder in `evaluate`, or a data set that brings
    them.
    """
    same_camera: tuple[str, str] | None = None
    """Two tracks of one camera that record at the same times with two exposures (HDRx,
    dual gain): video files or folders of frames in the folder CLIP. Movers are tracked
    in the first, so name the better exposed one first.
    """
    rig: int | None = None
    """How many still cameras of one make took the frames in turn: frame i is that of
    camera i modulo RIG. 1: the frames are those of one camera. Default: found.
    """
    poses: Path | None = None
    """Given poses (COLMAP model folder, transforms.json, poses_bounds.npy) instead of
    structure from motion.
    """
    tripod: bool = False
    """The camera stood still: no poses are estimated, and there is no depth. Default:
    found.
    """
    lens_distortion: str = "auto"
    """Radial distortion of the lens. auto: estimated, and left at none where the clip
    does not show any; none: a pinhole camera; K1 or K1,K2: as OpenCV has them, such as
    -0.2,0.03; or the file of a calibration: COLMAP's cameras.txt, nerfstudio's
    transforms.json, YAML or JSON of OpenCV, ROS or Kalibr. Frames are undistorted.
    """
    readout: float | Literal["auto"] = 0.0
    """Milliseconds from a rolling shutter's first row to its last: poses are those of
    the middle row, and `splat` is trained with it. auto: measured where the camera
    moves through space, which takes poses up to twice as long.
    """
    matcher: Matcher = "sift"
    """What finds and matches keypoints for poses. sift: needs no weights; aliked, disk:
    learned, matched by LightGlue (extra `neural`), seconds per pair of frames on a CPU,
    for footage in which SIFT finds too few matches.
    """
    flow: FlowName | Path | None = None
    """Where optical flow comes from. Default: semantic where the weights of its
    features are on this machine, else dis. semantic: by features that change little
    with the exposure; dis: OpenCV's dense inverse search, without weights; gmflow,
    raft: networks, see `hdr-nsff weights`; raft-finetuned: whichever network
    `finetune-flow` adapted; or a folder of maps made elsewhere: 00003_00004.npy (H, W,
    2) pixels per pair of frames.
    """
    flow_weights: Path | None = None
    """Weights of the network that --flow names: a file, or the folder of
    `finetune-flow`. Default: where weights are kept.
    """
    semantic: SemanticConfig = field(default_factory=SemanticConfig)
    """Settings of --flow semantic, the default where its weights are installed."""
    masks: Annotated[MaskName | Path | None, arg(name="mask", aliases=("--masks",))] = None
    """Where moving masks come from. motion: pixels whose flow the camera's motion does
    not explain (default); sam2: these, outlined by a network (extra `neural`); or a
    folder of masks made elsewhere: one PNG per frame in order, moving = white.
    """
    mask_weights: str = "sam2"
    """Weights of sam2: a name of `hdr-nsff weights`, OWNER/MODEL of the Hugging Face
    hub, or a model's folder.
    """
    mask_points: Path | None = None
    """Points that correct the prompts of sam2 or add to them: JSON as in
    `masks/prompts.json` of the scene folder, where the automatic ones are written.
    """
    depth: DepthName | Path | None = None
    """Where depth comes from. geometric: parallax, and the possible distances of movers
    (default); depth-anything: a network (extra `neural`), aligned to static points; or
    a folder of maps made elsewhere, one .npy, EXR or PNG per frame in order.
    """
    depth_weights: str = "depth-anything"
    """Weights of depth-anything, relative or metric: a name of `hdr-nsff weights`,
    OWNER/MODEL of the Hugging Face hub, or a model's folder.
    """
    depth_kind: Literal["metric", "disparity", "relative"] = "metric"
    """What the given depth maps hold: z-depth in the units of the poses (a PNG: 16
    bits, millimeters), 1 / z-depth (below 0: unknown), or disparity up to scale and
    shift.
    """
    estimate: tuple[Part, ...] = ()
    """Parts of a public data set to estimate although it gives them. Its depth is
    ignored too where its poses are.
    """
    truth_out: Path | None = None
    """Where the held-out views of a public data set go, for `evaluate --truth`.
    Default: OUT_truth, beside the scene folder.
    """
    redo: tuple[StepName, ...] = ()
    """Steps to redo although they are done."""
    device: str = "auto"
    """Where networks and the search for their features run: auto, cpu or cuda."""


@dataclass(frozen=True)
class Segment:
    """A part of a long clip that becomes a scene folder of its own."""

    name: str  # of its folder
    rows: tuple[int, ...]  # indices of its frames in the whole clip, rising
    clip_frames: int  # of the whole clip


@dataclass
class Work:
    """The unfinished scene folder, with what steps read of it."""

    config: PrepareConfig
    footage: Footage
    manifest: Manifest
    capture: Capture | None = None  # the training pictures of a public data set
    segment: Segment | None = None  # where the folder holds a part of the clip
    made: tuple[Path, ...] = ()  # the folder, and those above it that were not there before

    @property
    def folder(self) -> Path:
        """The scene folder."""
        return self.config.out

    @property
    def readout(self) -> Readout:
        """Of the rolling shutter, from the first row to the last, in frames as used."""
        readout = self.config.readout
        if readout == "auto":
            return readout
        return readout * 1e-3 / self.manifest.frame_interval

    def save(self) -> None:
        """Write the manifest."""
        self.manifest.save(self.folder)

    def capture_with(self, part: Part) -> Capture | None:
        """The data set, if it gives that part and the settings let it.

        They may replace the part, or ask for an estimate.
        """
        c = self.config
        replaced = part in c.estimate or getattr(c, part) is not None
        other_poses = c.poses is not None or "poses" in c.estimate
        if part == "depth" and other_poses:  # its depth is in units of its poses
            replaced = True
        if self.capture is None or replaced or not self.capture.parts()[part]:
            return None
        return self.capture

    def picture(self, frame: FrameEntry) -> Picture:
        """What the data set gives for a frame."""
        assert self.capture is not None
        return self.capture.by_source[frame.source]

    def time_of(self, source: str, number: int) -> float:
        """The time of a frame, in frames as used.

        `number` is its position in the footage of its camera.
        """
        if self.capture is None:
            return (number - self.config.start) // self.config.stride
        return self.own_time(self.capture.by_source[source].time)

    def own_time(self, time: float) -> float:
        """A time of the data set, in frames as used."""
        assert self.capture is not None
        first_files = [files[self.config.start] for files in self.sources()]
        first = min(self.capture.by_source[name].time for name in first_files)
        return round((time - first) / self.config.stride, 6)

    def frame_numbers(self) -> list[int]:
        """The position of every frame in the footage of its camera."""
        start, stride = self.config.start, self.config.stride
        frames = self.manifest.frames
        if self.capture is not None:
            return [start + int(f.time) * stride for f in frames]
        numbers = [0] * len(frames)
        for line in self.camera_frames():
            for place, index in enumerate(line):
                numbers[index] = start + place * stride
        return numbers

    def sources(self) -> list[list[str]]:
        """The names of the footage's files, camera by camera.

        Cameras without a frame `start` are left out.
        """
        names = []
        for files in self.footage.cameras:
            if len(files) > self.config.start:
                names.append([f.relative_to(self.footage.path).as_posix() for f in files])
        return names

    @cached_property
    def codes(self) -> Stack:
        """All frames as stored, (T, H, W, 3) uint8 or uint16, read when asked for."""
        files = [self.folder / f.image for f in self.manifest.frames]
        recent = RecentArrays(FRAME_MEMORY)
        shape = (len(files), self.manifest.height, self.manifest.width, 3)
        return Stack(lambda t: recent.get(t, lambda: read_codes(files[t])), shape)

    @property
    def video(self) -> Stack:
        """All frames as recorded, (T, H, W, 3) float32 in [0, 1]."""
        codes = self.codes
        return Stack(lambda t: codes_to_rgb(codes[t]), codes.shape)

    @cached_property
    def equalized(self) -> tuple[Stack, Stack]:
        """All frames at one brightness (T, H, W, 3), and clipped pixels (T, H, W).

        The histograms are those of training frames.
        """
        frames = self.manifest.frames
        num_brackets = 1 + max(f.bracket for f in frames)
        groups = [f.camera_id * num_brackets + f.bracket for f in frames]
        is_training = np.array([f.split == "train" for f in frames])
        equalizer = exposure.fit_equalizer(self.codes, groups, is_training)
        return exposure.equalized_stacks(self.codes, equalizer)

    @cached_property
    def visits(self) -> StaticPictures:
        """Of a rig: the static picture of each camera, from its training frames, and
        the moving pixels of all frames.
        """
        m = self.manifest
        learned = np.array([f.split == "train" for f in m.frames])
        return separate_movers(*self.equalized, m.places, learned)

    @cached_property
    def raw_flows(self) -> Flows:
        """All flow as it was matched, which poses and masks come from."""
        return self.read_flows({f.index: f.raw_flow for f in self.manifest.frames})

    @cached_property
    def refined_flows(self) -> Flows:
        """All flow as training reads it, that of movers from moving pixels alone."""
        return self.read_flows({f.index: f.flow for f in self.manifest.frames})

    def read_flows(self, files: dict[int, dict[int, FlowFiles]]) -> Flows:
        """Flow from the files of every frame to others, read when asked for."""
        pairs = [(i, j) for i, targets in files.items() for j in targets]
        names = [files[i][j] for i, j in pairs]
        shape = (len(pairs), self.manifest.height, self.manifest.width)
        recent = RecentArrays(FLOW_MEMORY)

        def flow(k: int) -> np.ndarray:
            file = self.folder / names[k].flow
            return recent.get((k, "flow"), lambda: read_npy(file).astype(np.float32))

        def valid(k: int) -> np.ndarray:
            file = self.folder / names[k].valid
            return recent.get((k, "valid"), lambda: read_mask(file))

        return Stack(flow, (*shape, 2)), Stack(valid, shape), np.array(pairs)

    def forget(self, names: tuple[str, ...]) -> None:
        """Drop cached properties: a step changed them, or they are not needed again."""
        for name in names:
            vars(self).pop(name, None)

    @property
    def train(self) -> list[FrameEntry]:
        """The training frames, in order."""
        return [f for f in self.manifest.frames if f.split == "train"]

    @cached_property
    def masks(self) -> np.ndarray:
        """Moving pixels (T, H, W) of all frames; InputError for one of another size."""
        m = self.manifest
        masks = []
        for f in m.frames:
            path = self.folder / str(f.mask)
            mask = read_mask(path)
            if mask.shape != (m.height, m.width):
                raise InputError(
                    f"{path}: the mask is {mask.shape[1]}x{mask.shape[0]}, the frames are "
                    f"{m.width}x{m.height}; make it that size, or add `--redo masks`"
                )
            masks.append(mask)
        return np.stack(masks)

    def training_masks(self) -> np.ndarray:
        """Moving pixels (T, H, W) of the training frames."""
        return self.masks[[f.index for f in self.train]]

    def training_clip(self) -> PosedVideo:
        """The training frames with their cameras, equalized, and their moving masks."""
        index = [f.index for f in self.train]
        video, clipped = self.equalized
        K, c2w = self.cameras()
        times = np.array([f.time for f in self.train], np.float64)
        return PosedVideo(
            K[index], c2w[index], times, video[index], clipped[index], self.masks[index]
        )

    def training_flows(self, flows: Flows) -> Flows:
        """Flows between training frames; pairs are positions among training frames."""
        index = np.array([f.index for f in self.train])
        flow, valid, pairs = flows
        pairs = pairs.reshape(-1, 2)  # also where there are none
        kept = np.isin(pairs, index).all(1)
        return flow[kept], valid[kept], np.searchsorted(index, pairs[kept])

    def static_points(self) -> np.ndarray:
        """The static points (N, 3) of structure from motion; (0, 3) without any."""
        if not self.manifest.points:
            return np.zeros((0, 3))
        return np.array(read_npy(self.folder / self.manifest.points))

    def static_depth(self) -> tuple[Stack, Stack]:
        """Disparity and confidence (T, H, W) of the training frames, without movers."""
        disparity = self.maps([str(f.static_disparity) for f in self.train])
        confidence = self.maps([str(f.static_confidence) for f in self.train])
        return disparity, confidence

    def maps(self, names: list[str]) -> Stack:
        """Maps (N, H, W) float32 of the scene folder, read when asked for."""
        shape = (len(names), self.manifest.height, self.manifest.width)
        return Stack(lambda k: read_npy(self.folder / names[k]).astype(np.float32), shape)

    def still(self) -> np.ndarray | None:
        """Pixels (T, H, W) of the moving masks that stand still, as parallax explains.

        None where depth is given, or the same everywhere: movers are then part of it.
        """
        names = [f.still for f in self.train if f.still is not None]
        if not names:
            return None
        return np.stack([read_mask(self.folder / name) for name in names])

    def camera(self, f: FrameEntry) -> tuple[np.ndarray, np.ndarray]:
        """K (3, 3) px and c2w (3, 4) of a frame."""
        return np.array(f.K, np.float64), np.array(f.c2w, np.float64)

    def cameras(self) -> tuple[np.ndarray, np.ndarray]:
        """K (T, 3, 3) px and c2w (T, 3, 4) of all frames."""
        cameras = [self.camera(f) for f in self.manifest.frames]
        return np.stack([K for K, _ in cameras]), np.stack([c2w for _, c2w in cameras])

    def camera_frames(self) -> list[list[int]]:
        """Per camera, and track of it, the indices of its frames in time."""
        indices: dict[tuple[int, int], list[int]] = {}
        for f in self.manifest.frames:
            indices.setdefault((f.camera_id, f.track), []).append(f.index)
        return [indices[line] for line in sorted(indices)]
