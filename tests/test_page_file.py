"""The viewer's page as one file: what it inlines, and what it may load."""

from __future__ import annotations

import base64
import gzip
import re

from hdr_nsff.viewer.page_file import (
    ENTRY,
    FOLDER,
    WORKER,
    Link,
    PageSettings,
    join_modules,
    make_page,
    modules_of,
)

NAME = re.compile(r"^(?:async )?(?:function\*?|class|const|let) (\w+)", re.MULTILINE)


def test_every_module_is_joined_once_after_what_it_imports() -> None:
    names = modules_of(ENTRY)
    assert sorted(names) == sorted({f.name for f in FOLDER.glob("*.js")} - {WORKER})
    assert names.index("motion.js") < names.index("renderer.js") < names.index(ENTRY)


def test_joined_modules_import_and_export_nothing() -> None:
    for entry in (ENTRY, WORKER):
        assert not re.search(r"^(import|export)\b", join_modules(entry), re.MULTILINE)


def test_names_of_joined_modules_differ() -> None:
    for entry in (ENTRY, WORKER):
        names = NAME.findall(join_modules(entry))
        assert sorted(names) == sorted(set(names))


def test_the_page_holds_its_scene_and_names_no_address() -> None:
    page = make_page("A <title>", b"the scene" * 50, PageSettings())
    assert "A &lt;title&gt;" in page and "@@" not in page
    found = re.search(r'<script id="scene" type="text/plain">([^<]*)</script>', page)
    assert found is not None
    assert gzip.decompress(base64.b64decode(found[1])) == b"the scene" * 50
    assert not re.search(r"https?://|src=|@import", page)
    assert "connect-src 'none'" in page


def test_the_page_of_a_server_asks_it_for_the_scene() -> None:
    page = make_page("Run", None, PageSettings(server=True))
    assert 'id="scene"' not in page
    assert "connect-src 'self'" in page


def test_links_cannot_end_the_script_that_holds_them() -> None:
    settings = PageSettings(videos=[Link("</script><b>.mp4", "Video")])
    assert "</script><b>" not in make_page("Run", None, settings)
