"""The weighted sum of all terms of a run, and its gradients.

Every term needs a weight. Terms of weight 0 are measured, but their gradients are not.
"""

from __future__ import annotations

from dataclasses import asdict

import torch
from torch import Tensor

from hdr_nsff.core.tensors import constant
from hdr_nsff.fields.splat.cuda_backends import kernels_on
from hdr_nsff.training.objective import LossWeights


def merge_weights(shared: LossWeights, *others: dict[str, float]) -> dict[str, float]:
    """All weights of a run by the names of their terms; no name may occur twice."""
    merged = asdict(shared)
    for weights in others:
        repeated = set(merged) & set(weights)
        assert not repeated, f"weights of one name in two places: {sorted(repeated)}"
        merged |= weights
    return merged


def counting(terms: dict[str, Tensor], weights: dict[str, float]) -> dict[str, Tensor]:
    """Those of the terms that count; one without a weight is an error."""
    unknown = set(terms) - set(weights)
    assert not unknown, f"terms without a weight: {sorted(unknown)}"
    return {name: value for name, value in terms.items() if weights[name]}


def weighted_sum(terms: dict[str, Tensor], weights: dict[str, float]) -> Tensor:
    """The sum of scalar terms by their weights."""
    counted = counting(terms, weights)
    values = torch.stack(list(counted.values()))
    factors = tuple(weights[name] for name in counted)
    return (values * constant(factors, values.device, values.dtype)).sum()


def backward(terms: dict[str, Tensor], weights: dict[str, float], batches: int) -> None:
    """Add the gradients of the weighted sum, as one of the `batches` of a step."""
    device = next(iter(terms.values())).device
    if not kernels_on(device):
        (weighted_sum(terms, weights) / batches).backward()
        return
    # a kernel's terms are parts of one vector: their weights are its gradient
    of_vectors: dict[Tensor, list[float]] = {}
    for name, term in counting(terms, weights).items():
        if term.requires_grad:
            vector, position = vector_of(term)
            of_parts = of_vectors.setdefault(vector, [0.0] * vector.numel())
            of_parts[position] += weights[name] / batches
    given = [constant(tuple(w), device, v.dtype).view_as(v) for v, w in of_vectors.items()]
    torch.autograd.backward(list(of_vectors), given)


def vector_of(term: Tensor) -> tuple[Tensor, int]:
    """The vector of which a scalar is a part, and its place there; or the scalar."""
    whole = term._base
    if whole is None or whole.ndim != 1 or not whole.is_contiguous() or not whole.requires_grad:
        return term, 0
    return whole, int(term.storage_offset() - whole.storage_offset())
