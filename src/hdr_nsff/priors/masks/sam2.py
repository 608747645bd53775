"""Moving masks by SAM 2, which outlines and tracks the objects of motion masks.

Flow finds moving objects but outlines them roughly, and loses one that pauses; the
network (Ravi et al., "SAM 2: Segment Anything in Images and Videos", 2024) outlines
well but does not know which objects move. Each object is prompted separately
(`prompts`) and tracked from its clearest frame, forward and backward.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from hdr_nsff.core.progress import say, track
from hdr_nsff.priors.masks.prompts import PromptedObject, iou
from hdr_nsff.priors.pretrained import IMAGENET_MEAN, IMAGENET_STD, architecture

BOX_LABELS = np.array([2, 3])  # of the two corners of a box, in SAM 2's prompts


@dataclass(frozen=True)
class Sam2Tuning:
    """Tuning constants of masks by SAM 2, hand-chosen on rendered scenes."""

    min_iou: float = 0.3
    """Intersection over union with the motion mask below which the network outlined
    another object.
    """
    max_covered_share: float = 0.5
    """An object is skipped if other objects cover more than this share of it."""


SAM2_TUNING = Sam2Tuning()


class ResizedFrames(Mapping[int, Tensor]):
    """The frames of a clip as input of the network, each made on demand.

    A long clip at 1024 x 1024 pixels would fill the memory.
    """

    def __init__(self, video: np.ndarray, size: int) -> None:
        self.video = video
        self.size = size

    def __len__(self) -> int:
        return len(self.video)

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self.video)))

    def __getitem__(self, frame: int) -> Tensor:
        """The frame (3, size, size), normalized."""
        image = torch.from_numpy(np.ascontiguousarray(self.video[frame], np.float32))
        rgb = functional.interpolate(
            image.permute(2, 0, 1)[None],
            (self.size, self.size),
            mode="bilinear",
            antialias=True,
        )
        return ((rgb - IMAGENET_MEAN) / IMAGENET_STD)[0]


def sam2_mask(
    network: Any,
    video: np.ndarray,
    objects: Sequence[PromptedObject],
    report: str = "sam2",
    tuning: Sam2Tuning = SAM2_TUNING,
) -> np.ndarray:
    """Moving pixels (T, H, W) bool: all `objects`, outlined in every frame.

    `network` is transformers' Sam2VideoModel, `video` (T, H, W, 3) equalized rgb in
    [0, 1]. Where the network outlines another object than the motion mask shows, the
    motion mask stays.
    """
    moving = np.zeros(video.shape[:3], bool)
    for prompted in track(objects, report):
        first = prompted.prompts[0].frame
        expected = prompted.masks.get(first)
        if expected is not None and moving[first][expected].mean() > tuning.max_covered_share:
            continue
        outline = track_object(network, video, prompted)
        if expected is not None:
            overlap = iou(outline[first], expected)
            if overlap < tuning.min_iou:
                say(
                    f"{report}: the outline of object {prompted.number} in frame {first} differs "
                    f"from its motion mask (overlap {overlap:.0%}): the motion mask is kept"
                )
                outline = motion_masks(prompted, video.shape[:3])
        moving |= outline
    return moving


def motion_masks(prompted: PromptedObject, shape: tuple[int, ...]) -> np.ndarray:
    """An object's motion masks as an array of `shape` (T, H, W) bool."""
    masks = np.zeros(shape, bool)
    for frame, mask in prompted.masks.items():
        masks[frame] = mask
    return masks


@torch.inference_mode()
def track_object(network: Any, video: np.ndarray, prompted: PromptedObject) -> np.ndarray:
    """One object's outline in every frame, (T, H, W) bool.

    It spreads from the object's prompts forward and backward in time.
    """
    height, width = video.shape[1:3]
    session = architecture("Sam2VideoInferenceSession")(
        video_height=height,
        video_width=width,
        inference_device=network.device,
        inference_state_device=network.device,
        dtype=network.dtype,
    )
    session.processed_frames = ResizedFrames(video, network.image_size)
    index = session.obj_id_to_idx(prompted.number)
    for prompt in prompted.prompts:
        inputs = prompt_inputs(
            prompt.points, prompt.labels, prompt.box, (height, width), network.image_size
        )
        session.add_point_inputs(index, prompt.frame, inputs)
        session.obj_with_new_inputs = [prompted.number]
        network(inference_session=session, frame_idx=prompt.frame)

    outline = np.zeros(video.shape[:3], bool)
    first = prompted.prompts[0].frame
    for backward in (False, True):
        for output in network.propagate_in_video_iterator(
            session, start_frame_idx=first, reverse=backward
        ):
            logits = functional.interpolate(
                output.pred_masks.float(), (height, width), mode="bilinear"
            )
            outline[output.frame_idx] = (logits[0, 0] > 0).cpu().numpy()
    return outline


def prompt_inputs(
    points: np.ndarray,
    labels: np.ndarray,
    box: np.ndarray | None,
    size: tuple[int, int],
    image_size: int,
) -> dict[str, Tensor]:
    """A prompt's points and box in the form that the network takes.

    `points` (N, 2) and `box` (4,) are in pixels of frames of `size` (height, width).
    The network takes a box as its two corners, before the points, in pixels of its
    square image, with centers at whole numbers.
    """
    corners = np.zeros((0, 2))
    if box is not None:
        corners = np.asarray(box).reshape(2, 2)
    positions = np.concatenate([corners, points]) * image_size / np.array(size[::-1]) - 0.5
    all_labels = np.concatenate([BOX_LABELS[: len(corners)], labels])
    return {
        "point_coords": torch.from_numpy(positions).float()[None, None],  # (1, 1, N, 2)
        "point_labels": torch.from_numpy(all_labels).int()[None, None],
    }
