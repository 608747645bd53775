"""Networks of the Hugging Face hub, loaded through transformers, which only this file
imports, when a network is needed.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from hdr_nsff.core.errors import InputError
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


def pretrained(network: str, name: str, given: Path | None = None) -> Any:
    """A network with its weights, in evaluation mode, without gradients, float32, on
    the CPU.

    `network`: a class of transformers ("Dinov2Model"); `name`: weights of
    `known_weights.KNOWN`, OWNER/MODEL, or a folder; `given`: a folder to load them from
    instead. InputError where transformers or the weights are missing, or do not fit.
    """
    network_class = architecture(network)
    folder = find(name, given)
    try:
        loaded, report = network_class.from_pretrained(
            folder, local_files_only=True, output_loading_info=True
        )
    except Exception as error:  # of many types: broken JSON, a cut-off file, sizes that do not fit
        reason = " ".join(str(error).split())[:200]
        raise InputError(
            f"{folder}: no {network} can be loaded ({reason}); name a folder that holds one"
        ) from error
    missing = sorted(report["missing_keys"])
    if missing:
        raise InputError(
            f"{folder}: holds no {network}, {missing[0]} is missing; name a folder that holds one"
        )
    return loaded.float().eval().requires_grad_(False)
