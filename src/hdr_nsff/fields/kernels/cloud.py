"""Numba kernels on the CPU that make the Gaussians of a moment from the learned numbers
of `splat`, with their flow to a neighboring frame and the field's own terms, and carry
gradients back.

Static Gaussians come first, then moving ones, then the time-local ones that are alive.
What each of them does stands in `moment.py` and `moment_gradients.py`. Sums are added
up chunk by chunk: the same result whatever the number of threads. The twins are
`cuda/cloud_kernels.py` and plain torch (`splat/training_view.py:draw_by_torch`).

Shapes: those of `moment.py`; A living time-local Gaussians, B bases, and P poses: one
now and, where there is flow, one at the neighbor's time.
"""

from __future__ import annotations

import numba

from hdr_nsff.core.jit import jit
from hdr_nsff.fields.kernels.footprint import FAST
from hdr_nsff.fields.kernels.moment import (
    NO_POSE,
    add_pose,
    make_local,
    make_moving,
    make_static,
    move_point,
    scalar,
)
from hdr_nsff.fields.kernels.moment_gradients import (
    local_gradients,
    motion_gradients,
    moving_gradients,
    static_gradients,
)

CHUNK = 256  # Gaussians whose sums are added up by one thread


def num_chunks(count: int) -> int:
    """In how many chunks `count` Gaussians are made."""
    return -(-count // CHUNK)


@scalar
def mean_pose(pose, mixture, m):
    """The mean of the bases' `pose` (B, POSE), by column m of the weights (B, M)."""
    a = NO_POSE
    for b in range(len(mixture)):
        a = add_pose(a, mixture[b, m], pose[b])
    return a


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def forward(
    s_means, s_quaternions, s_log_scales, s_logits, s_colors, s_offsets,
    m_means, m_quaternions, m_log_scales, m_logits, m_colors, m_offsets, presence,
    mixture, poses, l_means, l_velocities, l_quaternions, l_log_scales, l_colors,
    alive, neighbors, numbers, K, c2w, neighbor_K, neighbor_c2w,
    means, quaternions, scales, opacities, features, sums,
):  # fmt: skip
    """Fill the Gaussians of a moment, shaped like `rasterize` takes them, and `sums`
    (chunks, TERMS) of their terms, which must be 0 before.

    `mixture` (B, M) are weights of the bases, whose `poses` are (P, B, POSE). `alive`
    (A,) are rows of the time-local tables, `neighbors` (L, N). `features` (G, 4 or 6)
    are radiance, motion, and flow to the neighbor where wanted.
    """
    num_static, num_moving, count = len(s_means), len(m_means), len(means)
    for chunk in numba.prange(len(sums)):
        static = s_means, s_quaternions, s_log_scales, s_logits, s_colors, s_offsets
        moving = m_means, m_quaternions, m_log_scales, m_logits, m_colors, m_offsets, presence
        local = l_means, l_velocities, l_quaternions, l_log_scales, l_colors
        sight = numbers, K, c2w, neighbor_K, neighbor_c2w
        made = means, quaternions, scales, opacities, features
        own = sums[chunk]
        for g in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            m, lived = g - num_static, g - num_static - num_moving
            if m < 0:
                make_static(g, static, sight, made, own)
            elif lived < 0:
                pose, next_pose = mean_pose(poses[0], mixture, m), mean_pose(poses[-1], mixture, m)
                make_moving(g, m, pose, next_pose, moving, sight, made, own)
            else:
                r = alive[lived]
                make_local(g, r, len(alive), local, neighbors, sight, made, own)


@jit(parallel=True, nogil=True, fastmath=FAST, error_model="numpy")
def backward(
    s_means, s_log_scales, s_logits, s_colors, s_offsets,
    m_means, m_quaternions, m_log_scales, m_logits, m_colors, m_offsets, presence,
    mixture, poses, l_means, l_velocities, l_quaternions, l_log_scales, l_colors,
    alive, neighbors, numbers, K, c2w, neighbor_K, neighbor_c2w,
    d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms,
    gs_means, gs_quaternions, gs_log_scales, gs_logits, gs_colors, gs_offsets,
    gm_means, gm_quaternions, gm_log_scales, gm_logits, gm_colors, gm_offsets, gm_presence,
    g_mixture, g_poses, gl_means, gl_velocities, gl_quaternions, gl_log_scales, gl_colors,
    means_touched, velocities_touched, quaternions_touched, log_scales_touched, colors_touched,
):  # fmt: skip
    """Fill the gradients of static (`gs_`) and moving (`gm_`) tables and of `mixture`,
    and in `g_poses` (chunks, P, B, POSE) those of the poses, which must be 0 before.
    Add those of the time-local tables (`gl_`), and mark their rows.

    A `d_` is a gradient of what `forward` fills; `d_terms` is (TERMS,).
    """
    num_static, num_moving, count = len(s_means), len(m_means), len(d_means)
    for chunk in numba.prange(len(g_poses)):
        static = s_means, s_log_scales, s_logits, s_colors, s_offsets
        moving = m_means, m_quaternions, m_log_scales, m_logits, m_colors, m_offsets, presence
        local = l_means, l_velocities, l_quaternions, l_log_scales, l_colors
        sight = numbers, K, c2w, neighbor_K, neighbor_c2w
        d = d_means, d_quaternions, d_scales, d_opacities, d_features, d_terms
        of_static = gs_means, gs_quaternions, gs_log_scales, gs_logits, gs_colors, gs_offsets
        of_moving = (
            gm_means, gm_quaternions, gm_log_scales, gm_logits, gm_colors, gm_offsets, gm_presence
        )  # fmt: skip
        of_local = gl_means, gl_velocities, gl_quaternions, gl_log_scales, gl_colors
        marks = (
            means_touched, velocities_touched, quaternions_touched, log_scales_touched,
            colors_touched,
        )  # fmt: skip
        of_poses = g_poses[chunk]
        for g in range(chunk * CHUNK, min((chunk + 1) * CHUNK, count)):
            m, lived = g - num_static, g - num_static - num_moving
            if m < 0:
                static_gradients(g, static, sight, d, of_static)
            elif lived < 0:
                pose, next_pose = mean_pose(poses[0], mixture, m), mean_pose(poses[-1], mixture, m)
                motion = motion_gradients(g, m, pose, next_pose, moving, sight, d)
                moving_gradients(
                    g, m, pose, next_pose, motion[0], motion[1], moving, sight, d, of_moving
                )
                basis_gradients(m, m_means, motion, poses, mixture, g_mixture, of_poses)
            else:
                r = alive[lived]
                local_gradients(g, r, len(alive), local, neighbors, sight, d, of_local, marks)


@scalar
def basis_gradients(m, rest_means, motion, poses, mixture, g_mixture, g_poses):
    """Fill the gradients of moving Gaussian m's weights, and add to those of the poses
    (P, B, POSE); `motion` are the three gradients of where it is, will be, and turns.
    """
    rest = (rest_means[m, 0], rest_means[m, 1], rest_means[m, 2])
    d_here, d_there, d_turn = motion
    for b in range(len(mixture)):
        w, p = mixture[b, m], poses[0, b]
        x = move_point(p, rest)
        total = d_here[0] * x[0] + d_here[1] * x[1] + d_here[2] * x[2]
        total += d_turn[0] * p[12] + d_turn[1] * p[13] + d_turn[2] * p[14] + d_turn[3] * p[15]
        add_outer(g_poses[0, b], w, d_here, rest)
        for n in range(4):
            g_poses[0, b, 12 + n] += w * d_turn[n]
        if len(poses) > 1:
            x = move_point(poses[1, b], rest)
            total += d_there[0] * x[0] + d_there[1] * x[1] + d_there[2] * x[2]
            add_outer(g_poses[1, b], w, d_there, rest)
        g_mixture[b, m] = total


@scalar
def add_outer(pose, w, d, rest):
    """Add what a point at `rest`, of weight w and gradient d (3,), gives to a pose's
    gradient.
    """
    for axis in range(3):
        pose[4 * axis] += w * d[axis] * rest[0]
        pose[4 * axis + 1] += w * d[axis] * rest[1]
        pose[4 * axis + 2] += w * d[axis] * rest[2]
        pose[4 * axis + 3] += w * d[axis]
