"""Networks of the Hugging Face hub, loaded through transformers: its only door, and
imported when one is asked for.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from hdr_nsff.core.errors import InputError
from hdr_nsff.priors.weights import find

IMAGENET_MEAN = torch.tensor([0.485, 0.456, 0.406])[
    :, None, None
]  # of rgb in [0, 1]: what nearly all of them were trained with
IMAGENET_STD = torch.tensor([0.229, 0.224, 0.225])[:, None, None]


def architecture(name: str) -> Any:
    """A class of transformers by its name; InputError where transformers is not
    installed or has none.
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
            f"transformers {transformers.__version__} has no {name}; `pip install -U 'hdr-nsff[neural]'`"
        )
    return getattr(transformers, name)


def pretrained(network: str, name: str, given: Path | None = None) -> Any:
    """The network class `network` of transformers ("Dinov2Model") with the weights
    `name` (of `weights.KNOWN`, OWNER/MODEL, or a folder), in evaluation mode, without
    gradients, float32, on the CPU.

    `given`: a folder to load it from instead. InputError where transformers or the
    weights are missing, or do not fit the network.
    """
    kind = architecture(network)
    folder = find(name, given)
    try:
        loaded, report = kind.from_pretrained(
            folder, local_files_only=True, output_loading_info=True
        )
    except Exception as error:  # of many types: broken JSON, a cut-off file, sizes that do not fit
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{folder}: no {network} can be loaded ({reason}); name a folder that holds one"
        ) from error
    if lacking := sorted(report["missing_keys"]):
        raise InputError(
            f"{folder}: holds no {network}, {lacking[0]} is missing; name a folder that holds one"
        )
    return loaded.float().eval().requires_grad_(False)
