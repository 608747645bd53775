"""The published terms on samples in plain loops: of every sample by axes, and as the
preset `paper` adds them up.
"""

from itertools import pairwise

from published import RAYS, Case, add, decode, disocclusion_of, flow_of, raw_at, samples_of

from hdr_nsff.training.objective import Objective
from hdr_nsff.training.presets import PRESETS

# shares of a ray's samples, from the camera on, that smoothness and kinetic energy see
SMOOTH_SHARE, KINETIC_SHARE = 0.95, 0.9


def cycle_errors(case: Case, side: int, offset: int) -> list[tuple[float, list[float]]]:
    """Of every sample, 1 - w, and the flow there and back (3,) in cube units."""
    errors = []
    for i, k, x in samples_of(case):
        seen = 1 - disocclusion_of(raw_at(case, x, case.knot, i), side)
        there = case.flow(i, k, side)
        back = flow_of(raw_at(case, add(x, there), case.knot + offset, i), 1 - side)
        errors.append((seen, add(there, back)))
    return errors


def flow_steps(case: Case, side: int) -> list[list[float]]:
    """Differences (3,) of flow in scene units between neighboring samples of a ray."""
    steps = []
    for i in range(RAYS):
        moves = []
        for k in range(round(SMOOTH_SHARE * case.num_samples)):
            x = case.base.samples.coords[i, k].tolist()
            moves.append(decode(case, add(x, case.flow(i, k, side))) - decode(case, x))
        steps += [(b - a).tolist() for a, b in pairwise(moves)]
    return steps


def accelerations(case: Case, offset: int = 0) -> list[list[float]]:
    """Flow forward plus flow backward (3,) in scene units, of every sample that counts:
    where it is, or where it goes with the flow to a neighbor.
    """
    found = []
    for i, k, x in samples_of(case):
        if k >= round(KINETIC_SHARE * case.num_samples):
            continue
        where = x
        if offset:
            where = add(x, case.flow(i, k, 0 if offset > 0 else 1))
        raw = raw_at(case, where, case.knot + offset, i)
        ends = decode(case, add(where, flow_of(raw, 0))) + decode(case, add(where, flow_of(raw, 1)))
        found.append((ends - 2 * decode(case, where)).tolist())
    return found


# Added up over axes


def cycle(case: Case, side: int, offset: int) -> float:
    """`cycle` of one neighbor."""
    error = weights = 0.0
    for seen, residual in cycle_errors(case, side, offset):
        error += seen * sum(abs(x) for x in residual)
        weights += seen
    return error / weights


def roughness(case: Case, side: int) -> float:
    """`smoothness` of the flow to one neighbor."""
    steps = flow_steps(case, side)
    return sum(abs(x) for step in steps for x in step) / len(steps)


def energy(case: Case, offset: int = 0) -> float:
    """`kinetic`, once: at the samples, or where they go with the flow to a neighbor."""
    bends = accelerations(case, offset)
    return sum(0.5 * x * x for bend in bends for x in bend) / len(bends)


def summed(case: Case, name: str) -> float:
    """A term of the field as the preset's objective adds it up."""
    objective = Objective({}, "scene", 1.0, published=PRESETS["paper"].published)
    return float(objective.reduce({name: case.terms[name]})[name])
