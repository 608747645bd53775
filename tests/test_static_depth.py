"""The static depth of still cameras: once for each, and none that is mere chance."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from posed_planes import H, W, cameras_at, plane, posed_video

from hdr_nsff.prepare.steps import static_depth
from hdr_nsff.prepare.steps.static_depth import MIN_KNOWN_SHARE, depth_of_cameras, least_spacing
from hdr_nsff.scene.manifest import FrameEntry, Manifest, StepRecord

EYES = [(0.0, 0, 0), (0.4, 0, 0), (0.4, 0.3, 0)]
CAMERA_OF = np.array([0, 0, 1, 1, 2, 2])


def work_of(c2w: np.ndarray, rig: int) -> Any:
    """Two frames of each camera."""
    frames = c2w[CAMERA_OF]
    clip = posed_video(frames, video=plane(frames, 3.0, 0.2)[0])
    return SimpleNamespace(manifest=SimpleNamespace(rig=rig), training_clip=lambda: clip)


def test_the_least_spacing_is_of_cameras_at_different_places() -> None:
    assert least_spacing(cameras_at(*EYES, EYES[0])) == pytest.approx(0.3)


@pytest.mark.parametrize("rig", [1, 3])
@pytest.mark.parametrize("share", [0.0, MIN_KNOWN_SHARE / 2, 2 * MIN_KNOWN_SHARE])
@pytest.mark.parametrize("least", [0.0, 0.3])  # confidence of the other pixels
def test_depth_that_cameras_hardly_agree_about_is_a_picture_before_each(
    least: float, share: float, rig: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(clip: Any, *arguments: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        assert len(clip.video) == 3  # one picture of each camera
        confidence = np.full((3, H, W), least, np.float32)
        confidence[:, :, : round(share * W)] = 1
        depth = np.broadcast_to(np.float32([[[2]], [[3]], [[4]]]), confidence.shape)
        return 1 / depth, confidence, np.zeros(confidence.shape, bool)

    monkeypatch.setattr(static_depth, "static_geometric_depth", found)
    work = work_of(cameras_at(*EYES), rig)
    disparity, confidence, still = depth_of_cameras(work, CAMERA_OF, np.zeros((0, 3)))
    assert not still.any() and still.shape == (6, H, W)
    hints = share > 0 or least > 0
    by_chance = rig == 1 and hints and share < MIN_KNOWN_SHARE
    for t, camera in enumerate(CAMERA_OF):
        assert disparity[t] == pytest.approx(1 / (0.15 if by_chance else 2 + camera))
        assert confidence[t].any() == (hints and not by_chance)


def test_a_network_that_never_ran_is_not_the_source_of_depth() -> None:
    entry = FrameEntry(index=0, image="", source="", time=0, bracket=0)
    m = Manifest(source="clip", width=W, height=H, parallax="none", frames=[entry])
    m.steps["poses"] = StepRecord(details={"range": [0.5, 2.0]})
    config = SimpleNamespace(depth="depth-anything")
    work: Any = SimpleNamespace(manifest=m, config=config, train=[entry])
    work.capture_with = lambda part: None
    found = static_depth.find_static_depth(work)
    assert found.details["source"] == "geometric"
