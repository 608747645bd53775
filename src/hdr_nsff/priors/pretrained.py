"""Networks of the Hugging Face hub, loaded through transformers: its only door, and imported when one is asked for."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hdr_nsff.errors import InputError
from hdr_nsff.priors.weights import find


def pretrained(architecture: str, name: str, given: Path | None = None) -> Any:
    """The network `architecture` (a class of transformers, "Dinov2Model") with the weights `name` (of `weights.KNOWN`, or OWNER/MODEL),
    in evaluation mode, without gradients, float32, on the CPU.

    `given`: a folder to load it from instead. InputError where transformers or the weights are missing, or do not fit the architecture."""
    try:
        import transformers
    except ImportError as error:
        raise InputError(f"{name}: transformers is not installed ({error}); `pip install 'hdr-nsff[neural]'`") from error
    folder = find(name, given)
    transformers.logging.set_verbosity_error()
    transformers.logging.disable_progress_bar()
    try:
        network, report = getattr(transformers, architecture).from_pretrained(
            folder, local_files_only=True, output_loading_info=True
        )
    except Exception as error:  # of many types: broken JSON, a cut-off file, sizes that do not fit
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{folder}: no {architecture} can be loaded ({reason}); name a folder that holds one") from error
    if lacking := sorted(report["missing_keys"]):
        raise InputError(f"{folder}: the weights of no {architecture}, {lacking[0]} is missing; name a folder that holds one")
    return network.float().eval().requires_grad_(False)
