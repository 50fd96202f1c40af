"""The picture from what was seen along rays, and what its gradient is to what was seen: a thread takes a ray."""

from typing import no_type_check

import triton
import triton.language as tl

from nerfdiff.render.kernels.samples import absorbed, four, store_four, store_vector, vector


@triton.jit
@no_type_check
def start(distances, uniform, drawn, row):
    """Begin a walk over both lists: the next place in each, and the next two distances of each."""
    none, second = tl.zeros(row.shape, tl.int32), tl.full(row.shape, 1, tl.int32)
    return (
        none,
        none,
        tl.load(distances, mask=row & (none < uniform), other=float("inf")),
        tl.load(distances + 1, mask=row & (second < uniform), other=float("inf")),
        tl.load(distances + uniform, mask=row & (none < drawn), other=float("inf")),
        tl.load(distances + uniform + 1, mask=row & (second < drawn), other=float("inf")),
    )


@triton.jit
@no_type_check
def advance(distances, walk, uniform, drawn, row):
    """The walk a sample further; that sample's place and distance, and the distance after it.

    What is read is needed two samples later at the earliest: nothing waits for it.
    """
    u, d, u_next, u_second, d_next, d_second = walk
    first = (d >= drawn) | ((u < uniform) & (u_next <= d_next))
    slot, here = tl.where(first, u, uniform + d), tl.where(first, u_next, d_next)
    left = tl.where(first, u + 2 < uniform, d + 2 < drawn)
    third = tl.load(distances + slot + 2, mask=row & left, other=float("inf"))
    u, d = tl.where(first, u + 1, u), tl.where(first, d, d + 1)
    u_next, u_second = tl.where(first, u_second, u_next), tl.where(first, third, u_second)
    d_next, d_second = tl.where(first, d_next, d_second), tl.where(first, d_second, third)
    return (u, d, u_next, u_second, d_next, d_second), slot, here, tl.minimum(u_next, d_next)


@triton.jit(do_not_specialize=["n", "first", "count", "uniform", "samples"])
@no_type_check
def composite_kernel(
    near, far, distances, values, stops, rgb, opacity, depth, background, n, first, count, uniform, samples,
    OPAQUE: tl.constexpr, STOP: tl.constexpr, R: tl.constexpr,
):  # fmt: skip
    """Colour, opacity and depth of rays [scenes, first : first + count] of n, R per program.

    Args:
        distances: [scenes, count, samples]: `uniform` ascending ones, then the others, ascending.
        values: red, green, blue and density there [scenes, count, samples, 4]; STOP: of what is not behind `stops`
            [scenes, count]. The rest is empty.
        OPAQUE: the last sample lets nothing through, in place of a background.
    """
    scene = tl.program_id(1).to(tl.int64)
    ray = tl.program_id(0) * R + tl.arange(0, R)
    here = ray < count
    at = scene * n + first + ray
    edge = tl.load(near + at, mask=here, other=0.0)
    end = tl.load(far + at, mask=here, other=0.0)
    row = scene * count + ray
    stop = tl.load(stops + row, mask=here, other=0.0) if STOP else tl.full([R], float("inf"), tl.float32)
    distances += row * samples
    drawn = samples - uniform

    through = tl.full([R], 1.0, tl.float32)
    total = tl.zeros([R], tl.float32)
    reach = tl.zeros([R], tl.float32)
    red = tl.zeros([R], tl.float32)
    green = tl.zeros([R], tl.float32)
    blue = tl.zeros([R], tl.float32)
    walk = start(distances, uniform, drawn, here)
    walk, slot, t, after = advance(distances, walk, uniform, drawn, here)
    seen = four(values, row * samples + slot, here & (t <= stop))
    for i in range(samples):
        r, g, b, density = seen
        walk, slot, next_t, next_after = advance(distances, walk, uniform, drawn, here)
        seen = four(values, row * samples + slot, here & (next_t <= stop) & (i < samples - 1))  # in advance
        next_edge = tl.where(i == samples - 1, end, 0.5 * (t + after))
        optical = density * (next_edge - edge)
        share = absorbed(optical)
        if OPAQUE:
            share = tl.where(i == samples - 1, 1.0, share)
        weight = through * share
        total += weight
        reach += weight * t
        red += weight * r
        green += weight * g
        blue += weight * b
        through *= tl.exp(-optical)
        edge, t, after = next_edge, next_t, next_after

    behind = 0.0 if OPAQUE else (1.0 - total) * background
    store_vector(rgb, at, red + behind, green + behind, blue + behind, here)
    tl.store(opacity + at, total, mask=here)
    reached = total > 1e-6
    tl.store(depth + at, tl.where(reached, reach / tl.where(reached, total, 1.0), end), mask=here)


@triton.jit(do_not_specialize=["n", "first", "count", "uniform", "samples"])
@no_type_check
def composite_gradient_kernel(
    scene_near, scene_far, near, far, distances, values, stops,
    rgb, opacity, depth, d_rgb, d_opacity, d_depth, d_values,
    background, scale, n, first, count, uniform, samples,
    OPAQUE: tl.constexpr, STOP: tl.constexpr, R: tl.constexpr,
):  # fmt: skip
    """Gradients [scenes, count, samples, 4] of the output layer's numbers, from those of the picture.

    With w_i = T_i (1 − exp(−o_i)) and g_i = ∂L/∂w_i, ∂L/∂o_i = g_i T_{i+1} − Σ_{j>i} g_j w_j, and the sum over all j
    is known from the picture, so that one walk from front to back is enough.
    """
    scene = tl.program_id(1).to(tl.int64)
    steepest = scale / (tl.load(scene_far + scene) - tl.load(scene_near + scene))
    ray = tl.program_id(0) * R + tl.arange(0, R)
    here = ray < count
    at = scene * n + first + ray
    edge = tl.load(near + at, mask=here, other=0.0)
    end = tl.load(far + at, mask=here, other=0.0)
    row = scene * count + ray
    stop = tl.load(stops + row, mask=here, other=0.0) if STOP else tl.full([R], float("inf"), tl.float32)
    distances += row * samples
    drawn = samples - uniform

    g_red, g_green, g_blue = vector(d_rgb, at, here)
    total = tl.load(opacity + at, mask=here, other=0.0)
    reached = total > 1e-6
    expected = tl.load(depth + at, mask=here, other=0.0)
    g_depth = tl.load(d_depth + at, mask=here, other=0.0)
    g_depth = tl.where(reached, g_depth / tl.where(reached, total, 1.0), 0.0)
    g_weight = tl.load(d_opacity + at, mask=here, other=0.0)
    seen_red, seen_green, seen_blue = vector(rgb, at, here)
    later = g_red * seen_red + g_green * seen_green + g_blue * seen_blue + g_weight * total
    if not OPAQUE:
        g_behind = (g_red + g_green + g_blue) * background
        later -= g_behind
        g_weight -= g_behind
    # no weight's gradient is greater: colours are in [0, 1], distances in [near, far]
    most = tl.abs(g_red) + tl.abs(g_green) + tl.abs(g_blue) + tl.abs(g_weight) + tl.abs(g_depth) * (end - edge)

    through = tl.full([R], 1.0, tl.float32)
    walk = start(distances, uniform, drawn, here)
    walk, slot, t, after = advance(distances, walk, uniform, drawn, here)
    seen = four(values, row * samples + slot, here & (t <= stop))
    for i in range(samples):
        red, green, blue, density = seen
        walk, next_slot, next_t, next_after = advance(distances, walk, uniform, drawn, here)
        seen = four(values, row * samples + next_slot, here & (next_t <= stop) & (i < samples - 1))  # in advance
        next_edge = tl.where(i == samples - 1, end, 0.5 * (t + after))
        length = next_edge - edge
        optical = density * length
        share = absorbed(optical)
        if OPAQUE:
            share = tl.where(i == samples - 1, 1.0, share)
        weight = through * share
        g = g_weight + g_depth * (t - expected) + g_red * red + g_green * green + g_blue * blue
        later -= g * weight
        through *= tl.exp(-optical)
        # What comes later weighs no more than what gets there. The difference alone would leave its rounding
        # errors where nothing does, and steep densities would make them large.
        bound = through * most
        limited = tl.where(later > bound, bound, tl.where(later < -bound, -bound, later))
        # the softplus's slope is 1 − e^−softplus
        d_density = (g * through - limited) * length * steepest * absorbed(density / steepest)
        if OPAQUE:
            d_density = tl.where(i == samples - 1, 0.0, d_density)
        d_red = weight * g_red * red * (1.0 - red)
        d_green = weight * g_green * green * (1.0 - green)
        d_blue = weight * g_blue * blue * (1.0 - blue)
        store_four(d_values, row * samples + slot, d_red, d_green, d_blue, d_density, here)
        edge, slot, t, after = next_edge, next_slot, next_t, next_after
