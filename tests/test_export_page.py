"""A run as one HTML file or as a scene file; refusals are sentences."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import pytest
from test_export_gaussians import make_run

from hdr_nsff.core.errors import InputError
from hdr_nsff.rendering.export import ExportConfig, check_settings
from hdr_nsff.rendering.export_page import export_page, find_videos, link_below, run_title
from hdr_nsff.scene.scene import Scene
from hdr_nsff.viewer.scene_file import from_bytes


def test_a_page_and_its_bare_scene_are_written_and_replaced(toy: Scene, tmp_path: Path) -> None:
    run = make_run(toy, tmp_path / "clip" / "run")
    for _ in range(2):
        page = export_page(run, tmp_path / "scene.html")
        bare = export_page(run, tmp_path / "scene.hdr4d")
    scene = from_bytes(bare.read_bytes())
    assert scene.title == "clip" and scene.count() > 400
    assert "<title>clip</title>" in page.read_text()


def test_a_file_of_someone_else_is_left_alone(toy: Scene, tmp_path: Path) -> None:
    mine = tmp_path / "index.html"
    mine.write_text("<p>mine</p>")
    with pytest.raises(InputError, match="was not made by export"):
        export_page(make_run(toy, tmp_path / "run"), mine)
    assert mine.read_text() == "<p>mine</p>"


def test_a_field_without_gaussians_has_no_page(toy: Scene, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="hdr-nsff view"):
        export_page(make_run(toy, tmp_path / "run", "grid"), tmp_path / "scene.html")


def test_videos_below_the_page_are_linked(toy: Scene, tmp_path: Path) -> None:
    run = make_run(toy, tmp_path / "run")
    (tmp_path / "render").mkdir()
    (tmp_path / "render" / "training.mp4").write_bytes(b"")
    assert [link.href for link in find_videos(run, tmp_path)] == ["render/training.mp4"]
    assert find_videos(run, tmp_path / "elsewhere") == []


def test_links_to_videos_are_quoted(tmp_path: Path) -> None:
    video = tmp_path / "take#2 50%" / "slowmo.mp4"
    video.parent.mkdir()
    video.write_bytes(b"")
    link = link_below(video, tmp_path, "Video")
    assert link is not None and link.href == "take%232%2050%25/slowmo.mp4"


def test_an_hdr_video_is_inside_the_page_if_it_is_small(
    toy: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(toy, tmp_path / "run")
    (tmp_path / "render").mkdir()
    (tmp_path / "render" / "training_pq.mp4").write_bytes(b"pq")
    (tmp_path / "render" / "training_hlg_av1.mp4").write_bytes(b"hlg")
    held = base64.b64encode(b"hlg").decode()
    page = export_page(run, tmp_path / "scene.html").read_text()
    assert f'<script id="training_hlg_av1.mp4" type="text/plain">{held}</script>' in page
    assert '{"href": "training_hlg_av1.mp4", "text": "HDR clip"}' in page
    monkeypatch.setattr("hdr_nsff.rendering.export_page.MAX_CLIP_BYTES", 2)
    page = export_page(run, tmp_path / "scene.html").read_text()
    assert held not in page
    assert '{"href": "render/training_hlg_av1.mp4", "text": "HDR clip"}' in page


def test_of_two_codecs_the_one_that_more_browsers_play_stays_inside(
    toy: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(toy, tmp_path / "run")
    (tmp_path / "render").mkdir()
    for name, size in (("training_hlg.mp4", 5), ("training_hlg_av1.mp4", 4)):
        (tmp_path / "render" / name).write_bytes(bytes(size))
    for limit, names in ((9, ["hlg.mp4", "hlg_av1.mp4"]), (8, ["hlg_av1.mp4"])):
        monkeypatch.setattr("hdr_nsff.rendering.export_page.MAX_CLIP_BYTES", limit)
        page = export_page(run, tmp_path / "scene.html").read_text()
        links = [{"href": f"training_{name}", "text": "HDR clip"} for name in names]
        assert f'"hdr_clips": {json.dumps(links)}' in page
        assert page.count('.mp4" type="text/plain">') == len(names)


def test_a_page_in_any_folder_holds_the_hdr_video_of_its_own_run(
    toy: Scene, tmp_path: Path
) -> None:
    run = make_run(toy, tmp_path / "clip" / "run")
    for folder, data in (("clip", b"mine"), ("sent", b"of another run")):
        (tmp_path / folder / "render").mkdir(parents=True)
        (tmp_path / folder / "render" / "training_hlg.mp4").write_bytes(data)
    page = export_page(run, tmp_path / "sent" / "scene.html").read_text()
    assert base64.b64encode(b"mine").decode() in page
    assert base64.b64encode(b"of another run").decode() not in page


def test_a_small_video_as_filmed_is_inside_the_page(
    toy: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(toy, tmp_path / "run")
    (tmp_path / "render").mkdir()
    for name in ("training", "bullet"):
        (tmp_path / "render" / f"{name}.mp4").write_bytes(name.encode())
    held = base64.b64encode(b"training").decode()
    others = {"href": "render/bullet.mp4", "text": "Bullet time"}
    for limit, href in ((8, "training.mp4"), (7, "render/training.mp4")):
        monkeypatch.setattr("hdr_nsff.rendering.export_page.MAX_VIDEO_BYTES", limit)
        page = export_page(run, tmp_path / "scene.html").read_text()
        links = [{"href": href, "text": "Video"}, others]
        assert f'"videos": {json.dumps(links)}' in page
        assert (f'<script id="training.mp4" type="text/plain">{held}</script>' in page) == (
            limit == 8
        )


@pytest.mark.parametrize("options", [{"ply": True}, {"time": 1.0}, {"layout": "nerfstudio"}])
def test_options_that_a_page_has_no_use_for_are_refused(options: dict) -> None:
    with pytest.raises(InputError, match="a page"):
        check_settings(ExportConfig(Path("run"), Path("scene.html"), **options))


def test_titles_come_from_the_folder_around_a_run() -> None:
    assert run_title(Path("/out/garden/run")) == "garden"
    assert run_title(Path("/out/garden")) == "garden"
