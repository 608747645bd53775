"""Draws a view of a scene file (docs/formats.md, "Scene file") in plain numpy.

    python draw_scene.py scene.html 12.5 picture.npy

draws the first filmed camera at a time in frames: linear radiance (H, W, 3), float32.
"""

import sys

import numpy as np
from read_scene import read


def at_knots(values, share):
    """Values (K, ...) spread evenly over the clip, at a share of it: linear between."""
    position = share * (len(values) - 1)
    low = min(int(position), max(len(values) - 2, 0))
    high = min(low + 1, len(values) - 1)
    return values[low] + (position - low) * (values[high] - values[low])


def cubic(values, times, knot):
    """Values (T, ...) of `times` (T) at a knot: a cubic with continuous velocity."""
    if len(times) == 1:
        return values[0]
    gaps, low = np.diff(times), min(int(knot), len(times) - 2)
    slopes = np.diff(values, axis=0) / gaps.reshape(-1, *[1] * (values.ndim - 1))

    def velocity(k):
        """That of the parabola through three values; at the ends, that of a line."""
        if k in (0, len(gaps)):
            return slopes[max(k - 1, 0)]
        return (slopes[k - 1] * gaps[k] + slopes[k] * gaps[k - 1]) / (gaps[k - 1] + gaps[k])

    u, start, end = knot - low, velocity(low), velocity(low + 1)
    bend = (1 - u) * start - u * end + (2 * u - 1) * slopes[low]
    return values[low] + u * gaps[low] * (slopes[low] + (1 - u) * bend)


def rotations(q):
    """Rotation matrices (..., 3, 3) of quaternions (..., 4) w x y z of any length."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]]  # fmt: skip
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def product(a, b):
    """Hamilton product of quaternions (..., 4)."""
    real = a[..., :1] * b[..., :1] - (a[..., 1:] * b[..., 1:]).sum(-1, keepdims=True)
    rest = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([real, rest], -1)


def gaussians(document, arrays, time, eye):
    """Means, roots R S, opacities and radiance of Gaussians, seen from `eye` (3,)."""
    times = document["times"]
    knot = float(np.interp(time, times, range(len(times))))
    share, parts = knot / max(len(times) - 1, 1), []
    for group in document["groups"]:
        prefix = group["name"] + "."
        g = {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)}
        means, quaternions, logits = g["means"], g["quaternions"], g["opacity_logits"]
        stored, window = g["log_radiance"], 1.0
        if "color_offsets" in g:
            stored = stored + at_knots(g["color_offsets"], share)
        if "opacity_offsets" in g:
            logits = logits + at_knots(g["opacity_offsets"], share)
        if "mixture" in g:  # shared rigid motions
            turns = cubic(arrays["bases.quaternions"], times, knot)
            turns = turns / np.linalg.norm(turns, axis=-1, keepdims=True)
            centers, shifts = arrays["bases.centers"], cubic(arrays["bases.shifts"], times, knot)
            moved = np.einsum("bij,nbj->nbi", rotations(turns), means[:, None] - centers)
            means = np.einsum("nb,nbi->ni", g["mixture"], moved + centers + shifts)
            quaternions = product(g["mixture"] @ turns, quaternions)
        if "velocities" in g:  # around a time of their own
            since = np.clip(time, times[0], times[-1]) - g["centers"]
            means = means + g["velocities"] * since[:, None]
            window = np.exp(-0.5 * (since / np.exp(g["log_durations"])) ** 2)
            window = np.where(window > 0.02, window, 0)
        roots = rotations(quaternions) * np.exp(g["log_scales"])[:, None]
        if "sh1" in g:  # the color changes with the direction of view
            directions = (means - eye) / np.linalg.norm(means - eye, axis=1, keepdims=True)
            stored = stored + np.clip(np.einsum("nci,ni->nc", g["sh1"], directions), -2, 2)
        bounded = document["radiance"] == "sigmoid"
        radiance = 1 / (1 + np.exp(-stored)) if bounded else np.exp(np.minimum(stored, 16))
        parts.append((means, roots, window / (1 + np.exp(-logits)), radiance))
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def draw(document, arrays, time, c2w, K, width, height):
    """Linear radiance (H, W, 3) that a camera sees at a time."""
    c2w, K, size = np.asarray(c2w), np.asarray(K), np.array([width, height])
    means, roots, opacities, radiance = gaussians(document, arrays, time, c2w[:, 3])
    t = (means - c2w[:, 3]) @ c2w[:, :3]  # camera points
    kept = np.flatnonzero((t[:, 2] > 0.01 * document["near"]) & (opacities >= 1 / 255))
    focal, middle = K[[0, 1], [0, 1]], K[:2, 2]
    edge = 0.15 * size / focal
    picture, left = np.zeros((height, width, 3)), np.ones((height, width))
    for g in kept[np.argsort(t[kept, 2], kind="stable")]:  # front to back
        z, root = t[g, 2], c2w[:, :3].T @ roots[g]
        slope = np.clip(t[g, :2] / z, -middle / focal - edge, (size - middle) / focal + edge)
        spread = (focal / z)[:, None] * (root[:2] - slope[:, None] * root[2])
        covariance = spread @ spread.T + 0.3 * np.eye(2)
        center = focal * t[g, :2] / z + middle
        reach = np.sqrt(2 * np.log(max(opacities[g] * 255, 1)) * covariance.diagonal())
        x0, y0 = np.clip(np.floor(center - reach), 0, size).astype(int)
        x1, y1 = np.clip(np.ceil(center + reach), 0, size).astype(int)
        if x0 >= x1 or y0 >= y1:
            continue
        d = np.stack(np.meshgrid(np.arange(x0, x1), np.arange(y0, y1)), -1) + 0.5 - center
        exponent = 0.5 * np.einsum("yxi,ij,yxj->yx", d, np.linalg.inv(covariance), d)
        alpha = np.minimum(opacities[g] * np.exp(-exponent), 0.999)
        weight = np.where(alpha >= 1 / 255, alpha, 0) * left[y0:y1, x0:x1]
        picture[y0:y1, x0:x1] += weight[..., None] * radiance[g]
        left[y0:y1, x0:x1] -= weight
    return (picture + left[..., None] * np.array(document["background"])).astype(np.float32)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    document, arrays = read(sys.argv[1])
    view = document["views"][0]
    size = document["width"], document["height"]
    np.save(sys.argv[3], draw(document, arrays, float(sys.argv[2]), view["c2w"], view["K"], *size))
