"""The verb `render`: its settings and their limits."""

from __future__ import annotations

from pathlib import Path

import pytest
from fakes import H, W, fake_run
from test_shot_views import path_file

from hdr_nsff.core.errors import InputError
from hdr_nsff.core.hdr_video import ENCODERS
from hdr_nsff.core.images import read_image
from hdr_nsff.rendering.output import Output
from hdr_nsff.rendering.render import RenderConfig, check_settings, check_size, render
from hdr_nsff.training.run_folder import Run


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every run folder holds the fake run."""
    monkeypatch.setattr(Run, "open", staticmethod(lambda folder, device: fake_run(Path(folder))))


@pytest.mark.usefixtures("opened")
def test_the_verb_renders_a_path_file_at_half_size(tmp_path: Path) -> None:
    found = render(RenderConfig(tmp_path, path_file(tmp_path, 0.1, 2.5), scale=0.5))
    assert found == {"ride": tmp_path / "render/ride.mp4"}
    assert read_image(tmp_path / "render/ride/00000.png").shape == (H // 2, W // 2, 3)


def test_settings_that_make_no_sense_are_refused_in_a_sentence(tmp_path: Path) -> None:
    requests = {
        "--scale 0: must be": RenderConfig(tmp_path, scale=0.0),
        "--scale inf: must be": RenderConfig(tmp_path, scale=float("inf")),
        "--factor 0: must be": RenderConfig(tmp_path, factor=0),
        "--fps -1: must be": RenderConfig(tmp_path, fps=-1.0),
        "--fps 1e-09: no video is that slow": RenderConfig(tmp_path, fps=1e-9),
        "--ev nan": RenderConfig(tmp_path, output=Output(ev=float("nan"))),
        "nothing left to write": RenderConfig(
            tmp_path, output=Output(exr="none", png=False, video=False)
        ),
        "not a run folder": RenderConfig(tmp_path),
    }
    for sentence, config in requests.items():
        with pytest.raises(InputError, match=sentence):
            render(config)


@pytest.mark.parametrize(
    ("path", "option", "value"),
    [
        ("all", "scale", 0.5),
        ("all", "frame", 3),
        ("all", "factor", 8),
        ("all", "fps", 60.0),
        ("training", "frame", 5),
        ("fixed", "budget", 5.0),
        ("fixed", "views", 9),
        ("bullet", "factor", 9),
        ("ride.json", "factor", 9),
    ],
)
def test_options_without_effect_are_refused(
    path: str, option: str, value: float, tmp_path: Path
) -> None:
    sentence = rf"--{option}: has no effect with --path .*use it with --path"
    with pytest.raises(InputError, match=sentence):
        check_settings(RenderConfig(tmp_path, path, **{option: value}))


def test_options_with_an_effect_are_accepted(tmp_path: Path) -> None:
    for path in ("fixed", "bullet", "slowmo", "my/ride.json"):
        check_settings(RenderConfig(tmp_path, path, frame=0, scale=0.5, fps=60))
    check_settings(RenderConfig(tmp_path, "slowmo", factor=8))
    check_settings(RenderConfig(tmp_path, "bullet", views=96))
    check_settings(RenderConfig(tmp_path, budget=5))


@pytest.mark.usefixtures("opened")
def test_hdr_videos_alone_may_be_wanted(tmp_path: Path) -> None:
    output = Output(exr="none", png=False, video=False, hdr_video=("hlg", "pq"), hdr_codec="av1")
    found = render(RenderConfig(tmp_path, path_file(tmp_path, 0.1, 2.5), scale=2, output=output))
    names = ["ride_hlg_av1.mp4", "ride_pq_av1.mp4", "ride_sheet.png"]
    assert sorted(p.name for p in (tmp_path / "render").glob("ride_*")) == names
    assert set(found.values()) == {tmp_path / "render" / name for name in names[:2]}


def test_a_missing_hdr_encoder_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(ENCODERS, "hevc", "libnone")
    with pytest.raises(InputError, match="this PyAV has no encoder libnone"):
        render(RenderConfig(tmp_path, output=Output(hdr_video=("pq",))))


@pytest.mark.parametrize("count", [10_001, 10**9, 10**400])
def test_more_views_than_a_shot_may_have_are_refused(count: int, tmp_path: Path) -> None:
    for config in (RenderConfig(tmp_path, views=count), RenderConfig(tmp_path, factor=count)):
        with pytest.raises(InputError, match="a shot has at most 10,000 views") as refusal:
            render(config)
        assert len(str(refusal.value)) < 100


@pytest.mark.usefixtures("opened")
@pytest.mark.parametrize("scale", [200.0, 1e6, 1e300])
def test_pictures_that_fill_the_memory_are_refused(scale: float, tmp_path: Path) -> None:
    # 64e6 pixels / (48 x 32) = 204.1^2
    with pytest.raises(InputError, match=r"at most 64 megapixels are rendered, use 204.* or less"):
        render(RenderConfig(tmp_path, "fixed", scale=1.03 * scale))
    assert not (tmp_path / "render").exists()


@pytest.mark.usefixtures("opened")
def test_pictures_of_no_pixels_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"at least 2 pixels a side, use 0\.07 or more"):
        render(RenderConfig(tmp_path, "fixed", scale=0.001))  # 2 / 32 = 0.0625


def test_the_advised_scales_are_accepted() -> None:
    check_size(W, H, 204.12)
    check_size(W, H, 0.07)
    check_size(7680, 4320, 1.0)
