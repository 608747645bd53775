"""Networks of the Hugging Face hub, loaded through transformers, which only this file
imports, when a network is needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from hdr_nsff.core.errors import InputError, shorten
from hdr_nsff.core.io import read_json
from hdr_nsff.priors.weights import find

# of rgb in [0, 1], (3, 1, 1): what nearly all of the networks were trained with
IMAGENET_MEAN = torch.tensor([0.485, 0.456, 0.406])[:, None, None]
IMAGENET_STD = torch.tensor([0.229, 0.224, 0.225])[:, None, None]


def architecture(name: str) -> Any:
    """A class of transformers by its name; InputError where transformers is not
    installed or does not have it.
    """
    try:
        import transformers
    except ImportError as error:
        raise InputError(
            f"{name}: transformers cannot be imported ({error}); `pip install 'hdr-nsff[neural]'`"
        ) from error
    transformers.logging.set_verbosity_error()
    transformers.logging.disable_progress_bar()
    if not hasattr(transformers, name):
        raise InputError(
            f"transformers {transformers.__version__} has no {name}; "
            "`pip install -U 'hdr-nsff[neural]'`"
        )
    return getattr(transformers, name)


def find_model(network: str, name: str, given: Path | None = None) -> Path:
    """The folder that `pretrained` loads; InputError where it is missing, or of another
    network, as far as its config.json shows.
    """
    expected = architecture(network).config_class.model_type
    folder = find(name, given)
    try:
        settings = dict(read_json(folder / "config.json"))
    except (OSError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder}: holds no {network}, its config.json cannot be read ({shorten(error)}); "
            "name a folder that holds one"
        ) from error
    kind = settings.get("model_type", expected)
    if kind != expected:
        raise InputError(
            f"{folder}: holds no {network} but weights of {shorten(kind)!r}; "
            "name a folder that holds one"
        )
    return folder


def pretrained(network: str, name: str, given: Path | None = None) -> Any:
    """A network with its weights, in evaluation mode, without gradients, float32, on
    the CPU.

    `network`: a class of transformers ("Dinov2Model"); `name`: weights of
    `known_weights.KNOWN`, OWNER/MODEL, or a folder; `given`: a folder to load them from
    instead. InputError where transformers or the weights are missing, or do not fit.
    """
    folder = find_model(network, name, given)
    try:
        loaded, report = architecture(network).from_pretrained(
            folder,
            local_files_only=True,
            output_loading_info=True,
            ignore_mismatched_sizes=True,  # its own error does not name them
        )
    except Exception as error:  # of many types: a cut-off file, settings that do not fit
        raise InputError(
            f"{folder}: no {network} can be loaded ({shorten(error, 200)}); "
            "name a folder that holds one"
        ) from error
    mismatched = sorted(name for name, *_ in report["mismatched_keys"])
    if mismatched:
        raise InputError(
            f"{folder}: the size of {mismatched[0]} is not that of its config.json; "
            "copy both files again"
        )
    missing = sorted(report["missing_keys"])
    if missing:
        raise InputError(
            f"{folder}: holds no {network}, {missing[0]} is missing; name a folder that holds one"
        )
    return loaded.float().eval().requires_grad_(False)
