"""Moving masks by SAM 2 (Ravi et al. 2024): it outlines what the motion mask points at,
and follows it through the clip both ways.

Motion tells what moves but draws it roughly, and loses it where it pauses; the network
draws well but does not know what moves. An object is asked about by itself
(`prompts.py`), so that each spreads from its own best frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from hdr_nsff.core.progress import say, track
from hdr_nsff.priors.masks.prompts import Mover, iou
from hdr_nsff.priors.pretrained import IMAGENET_MEAN, IMAGENET_STD, architecture

# intersection over union with the motion mask below which the network outlined
# something else
SAME = 0.3
# share of an object's outline that others hold already, from which it is not asked
# about again
COVERED = 0.5


class Pictures(Mapping[int, Tensor]):
    """The frames as the network wants them, each made when it is asked for: a long clip
    at 1024 x 1024 would fill the memory.
    """

    def __init__(self, video: np.ndarray, size: int) -> None:
        self.video, self.size = video, size

    def __len__(self) -> int:
        return len(self.video)

    def __iter__(self) -> Iterator[int]:
        return iter(range(len(self.video)))

    def __getitem__(self, frame: int) -> Tensor:
        """(3, size, size), normalized."""
        rgb = torch.from_numpy(np.ascontiguousarray(self.video[frame], np.float32)).permute(
            2, 0, 1
        )[None]
        rgb = functional.interpolate(rgb, (self.size, self.size), mode="bilinear", antialias=True)
        return ((rgb - IMAGENET_MEAN) / IMAGENET_STD)[0]


def sam2_mask(
    network: Any, video: np.ndarray, asked: Sequence[Mover], report: str = "sam2"
) -> np.ndarray:
    """What moves, (T, H, W) bool: all that `asked` points at, outlined in every frame
    of `video` (T, H, W, 3) equalized rgb in [0, 1].

    `network`: transformers' Sam2VideoModel. Where it outlines something else than the
    motion mask saw, the motion mask's outline stays.
    """
    total = np.zeros(video.shape[:3], bool)
    for mover in track(asked, report):
        first = mover.prompts[0].frame
        if mover.seen and total[first][mover.seen[first]].mean() > COVERED:
            continue
        outlined = follow(network, video, mover)
        if mover.seen and (same := iou(outlined[first], mover.seen[first])) < SAME:
            say(
                f"{report}: object {mover.number} in frame {first} is outlined unlike what moves there (overlap {same:.0%}): left as it was"
            )
            outlined = np.zeros_like(total)
            for frame, mask in mover.seen.items():
                outlined[frame] = mask
        total |= outlined
    return total


@torch.inference_mode()
def follow(network: Any, video: np.ndarray, mover: Mover) -> np.ndarray:
    """One object's outline in every frame, (T, H, W) bool, from its prompts forward and
    backward in time.
    """
    height, width = video.shape[1:3]
    session = architecture("Sam2VideoInferenceSession")(
        video_height=height,
        video_width=width,
        inference_device=network.device,
        inference_state_device=network.device,
        dtype=network.dtype,
    )
    session.processed_frames = Pictures(video, network.image_size)
    index = session.obj_id_to_idx(mover.number)
    for prompt in mover.prompts:
        session.add_point_inputs(
            index,
            prompt.frame,
            coordinates(
                prompt.points, prompt.labels, prompt.box, (height, width), network.image_size
            ),
        )
        session.obj_with_new_inputs = [mover.number]
        network(inference_session=session, frame_idx=prompt.frame)
    outlined = np.zeros(video.shape[:3], bool)
    for backward in (False, True):
        for seen in network.propagate_in_video_iterator(
            session, start_frame_idx=mover.prompts[0].frame, reverse=backward
        ):
            logits = functional.interpolate(
                seen.pred_masks.float(), (height, width), mode="bilinear"
            )
            outlined[seen.frame_idx] = (logits[0, 0] > 0).cpu().numpy()
    return outlined


def coordinates(
    points: np.ndarray,
    labels: np.ndarray,
    box: np.ndarray | None,
    size: tuple[int, int],
    image_size: int,
) -> dict[str, Tensor]:
    """Points (N, 2) and box in pixels of frames of `size` (height, width), as the
    network wants them: a box as its two corners, labeled 2 and 3, before the points;
    centers of the pixels of its square picture at whole numbers.
    """
    corners = np.zeros((0, 2)) if box is None else np.asarray(box).reshape(2, 2)
    places = np.concatenate([corners, points]) * image_size / np.array(size[::-1]) - 0.5
    meaning = np.concatenate([np.array([2, 3])[: len(corners)], labels])
    return {
        "point_coords": torch.from_numpy(places).float()[None, None],  # (1, 1, N, 2)
        "point_labels": torch.from_numpy(meaning).int()[None, None],
    }
