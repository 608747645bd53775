"""A reader of scene files (docs/formats.md, "Scene file") in plain numpy.

    python read_scene.py scene.html

lists what the file holds. It reads the page that `hdr-nsff export RUN scene.html`
writes, and bare `.hdr4d` files. draw_scene.py draws what it reads.
"""

import base64
import gzip
import json
import re
import sys
from pathlib import Path

import numpy as np

TYPES = {"F32": "<f4", "F16": "<f2", "I16": "<i2", "U16": "<u2", "U8": "u1"}


def read(path):
    """The document of a scene file, and its arrays by name."""
    data = Path(path).read_bytes()
    if found := re.search(rb'<script id="scene"[^>]*>([^<]*)</script>', data):
        data = gzip.decompress(base64.b64decode(found[1]))
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    document = json.loads(header.pop("__metadata__")["hdr4d"])
    arrays = {}
    for name, entry in header.items():
        first, last = entry["data_offsets"]
        values = np.frombuffer(body[first:last], TYPES[entry["dtype"]]).reshape(entry["shape"])
        arrays[name] = values * document["factors"].get(name, 1.0)
    return document, arrays


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    document, arrays = read(sys.argv[1])
    print(document["title"], len(document["times"]), "times,", len(document["views"]), "views")
    for name, values in arrays.items():
        print(name, values.shape)
