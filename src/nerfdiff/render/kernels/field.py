"""Device code of a triplane field, whose texels the decoder's first layer was applied to: f_θ(ξ_W(x)) at points.

Points are few and their hidden units side by side in neighbouring lanes: every sum over units stays in one warp, and
nothing waits for other warps. HALF: gathers and the activation are computed in fp16, two numbers at a time.
"""

from typing import no_type_check

import triton
import triton.language as tl

PORTABLE = tl.constexpr(triton.knobs.runtime.interpret)
"""Triton's interpreter knows no inline assembly."""


@triton.jit
@no_type_check
def add_product(a, b, c):
    """a · b + c of halves."""
    if PORTABLE:
        return (a * b + c).to(tl.float16)
    else:
        return tl.inline_asm_elementwise(
            "fma.rn.f16x2 $0, $1, $2, $3;", "=r,r,r,r", [a, b, c], dtype=tl.float16, is_pure=True, pack=2
        )


@triton.jit
@no_type_check
def tanh_halves(x):
    """tanh of halves, to 2⁻¹¹."""
    if PORTABLE:
        return (2.0 * tl.sigmoid(2.0 * x.to(tl.float32)) - 1.0).to(tl.float16)
    else:
        return tl.inline_asm_elementwise(
            "tanh.approx.f16x2 $0, $1;", "=r,r", [x], dtype=tl.float16, is_pure=True, pack=2
        )


@triton.jit
@no_type_check
def sigmoid(x, HALF: tl.constexpr):
    """1 / (1 + e⁻ˣ); HALF: to 2⁻¹²."""
    if HALF and not PORTABLE:
        half = tl.inline_asm_elementwise(
            "tanh.approx.f32 $0, $1;", "=f,f", [0.5 * x], dtype=tl.float32, is_pure=True, pack=1
        )
        return 0.5 * half + 0.5
    else:
        return tl.sigmoid(x)


@triton.jit
@no_type_check
def reciprocal(x):
    """1 / x, to the last bit or two."""
    if PORTABLE:
        return 1.0 / tl.where(x == 0.0, 1e-30, x)
    else:
        return tl.inline_asm_elementwise(
            "rcp.approx.ftz.f32 $0, $1;", "=f,f", [x], dtype=tl.float32, is_pure=True, pack=1
        )


@triton.jit
@no_type_check
def exponential(x):
    """eˣ, to the last bits; what is less than 10⁻³⁸ is 0."""
    if PORTABLE:
        return tl.exp(x)
    else:
        return tl.inline_asm_elementwise(
            "ex2.approx.ftz.f32 $0, $1;", "=f,f", [x * 1.4426950408889634], dtype=tl.float32, is_pure=True, pack=1
        )


@triton.jit
@no_type_check
def softplus(x, HALF: tl.constexpr):
    """log(1 + eˣ); accurate where it is tiny as well (Kahan's log1p), HALF: to 10⁻⁷ there."""
    e = exponential(-tl.abs(x))
    one_more = 1.0 + e
    if HALF:
        if PORTABLE:
            return tl.maximum(x, 0.0) + tl.log(one_more)
        else:
            doublings = tl.inline_asm_elementwise(
                "lg2.approx.ftz.f32 $0, $1;", "=f,f", [one_more], dtype=tl.float32, is_pure=True, pack=1
            )
            return tl.maximum(x, 0.0) + 0.6931471805599453 * doublings
    else:
        tiny = one_more == 1.0
        return tl.maximum(x, 0.0) + tl.where(tiny, e, tl.log(one_more) * (e / tl.where(tiny, 1.0, one_more - 1.0)))


@triton.jit
@no_type_check
def texel(unit, valid, SIZE: tl.constexpr):
    """The first of the two texels around a coordinate in [0, 1], how far on the second is, and where there is a slope.

    Borders repeat. Comparisons are written so that a NaN ends at the first texel, never outside the plane. What is not
    valid is put in the middle.
    """
    position = tl.where(valid, unit * SIZE - 0.5, 0.5 * SIZE - 0.5)
    sloped = (position > 0.0) & (position < SIZE - 1.0)
    position = tl.where(position > 0.0, tl.minimum(position, SIZE - 1.0), 0.0)
    first = tl.minimum(position, max(SIZE - 2, 0) * 1.0).to(tl.int32)
    return first, position - first.to(tl.float32), sloped


@triton.jit
@no_type_check
def project(frame, x, y, z):
    """x̃ scaled to [0, 1]³ inside the frustum, 1 / z, and whether the point lies beyond the near plane.

    As `Triplane.frustum_coordinates`: what lies before t_n counts for nothing.
    """
    start, inverse_extent, fx, cx, fy, cy = frame
    inverse = reciprocal(z)
    return fx * x * inverse + cx, fy * y * inverse + cy, (z - start) * inverse_extent, inverse, z >= start


@triton.jit
@no_type_check
def places(u, v, w, valid, H: tl.constexpr, W: tl.constexpr):
    """Return the texels (row, column) of W_xy, W_xz and W_yz, whose columns run along x, x and z."""
    across, down, deep = texel(u, valid, W), texel(v, valid, H), texel(w, valid, H)
    return (down, across), (deep, across), (down, deep if H == W else texel(w, valid, W))


@triton.jit
@no_type_check
def corners(row, column):
    """Weights of a cell's corners."""
    _, down, _ = row
    _, right, _ = column
    both = down * right
    return 1.0 - down - (right - both), right - both, down - both, both


@triton.jit
@no_type_check
def cell(PLANE: tl.constexpr, place, H: tl.constexpr, W: tl.constexpr):
    """The index of a cell's first texel."""
    row, column = place
    return PLANE * H * W + row[0] * W + column[0]


@triton.jit
@no_type_check
def gathered(table, places, HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr, HALF: tl.constexpr):
    """The hidden layer before its activation at points: [points, HP], fp16 or fp32."""
    right: tl.constexpr = HP if W > 1 else 0
    below: tl.constexpr = W * HP if H > 1 else 0
    found = tl.zeros([places[0][0][0].shape[0], HP], tl.float16 if HALF else tl.float32)
    for plane in tl.static_range(3):
        w00, w01, w10, w11 = corners(*places[plane])
        at = table + (cell(plane, places[plane], H, W) * HP)[:, None] + tl.arange(0, HP)[None, :]
        found = weighted(at, w00, found, HALF)
        found = weighted(at + right, w01, found, HALF)
        found = weighted(at + below, w10, found, HALF)
        found = weighted(at + (below + right), w11, found, HALF)
    return found


@triton.jit
@no_type_check
def weighted(at, weight, found, HALF: tl.constexpr):
    """`found` and a texel's share."""
    value = tl.load(at)
    if HALF:
        return add_product(value, tl.broadcast_to(weight.to(tl.float16)[:, None], value.shape), found)
    else:
        return found + value * weight[:, None]


@triton.jit
@no_type_check
def activated(pre, HALF: tl.constexpr):
    """SiLU of the hidden layer, and the sigmoid in it: fp32."""
    if HALF:
        # x σ(x) = x / 2 + x / 2 tanh(x / 2)
        half = pre * 0.5
        tanh = tanh_halves(half)
        return add_product(half, tanh, half).to(tl.float32), 0.5 * tanh.to(tl.float32) + 0.5
    else:
        gate = tl.sigmoid(pre)
        return pre * gate, gate


@triton.jit
@no_type_check
def scene_field(
    scene, table, K, near, far, w2, b2, image_width, image_height,
    SHARED: tl.constexpr, HIDDEN: tl.constexpr, HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr,
):  # fmt: skip
    """Load a scene's field before its first point: texels, frustum and output layer.

    The frustum: t_n, 1 / (t_f − t_n), and the intrinsics in units of the image's size.
    """
    start, end = tl.load(near + scene), tl.load(far + scene)
    fx, cx = tl.load(K + scene * 9) / image_width, tl.load(K + scene * 9 + 2) / image_width
    fy, cy = tl.load(K + scene * 9 + 4) / image_height, tl.load(K + scene * 9 + 5) / image_height
    own = 0 if SHARED else scene
    unit = tl.arange(0, HP)
    w2, b2 = w2 + own * 4 * HIDDEN + unit, b2 + own * 4
    weights = (
        tl.load(w2, mask=unit < HIDDEN, other=0.0).to(tl.float32),
        tl.load(w2 + HIDDEN, mask=unit < HIDDEN, other=0.0).to(tl.float32),
        tl.load(w2 + 2 * HIDDEN, mask=unit < HIDDEN, other=0.0).to(tl.float32),
        tl.load(w2 + 3 * HIDDEN, mask=unit < HIDDEN, other=0.0).to(tl.float32),
    )
    biases = (
        tl.load(b2).to(tl.float32),
        tl.load(b2 + 1).to(tl.float32),
        tl.load(b2 + 2).to(tl.float32),
        tl.load(b2 + 3).to(tl.float32),
    )
    return table + scene * 3 * H * W * HP, (start, 1.0 / (end - start), fx, cx, fy, cy), weights, biases


@triton.jit
@no_type_check
def query(
    table, frame, weights, biases, x, y, z, shift, scale,
    HP: tl.constexpr, H: tl.constexpr, W: tl.constexpr, HALF: tl.constexpr,
):  # fmt: skip
    """Colour and density per scene unit of points."""
    u, v, w, _, valid = project(frame, x, y, z)
    hidden, _ = activated(gathered(table, places(u, v, w, valid, H, W), HP, H, W, HALF), HALF)
    red = sigmoid(tl.sum(hidden * weights[0][None, :], 1) + biases[0], HALF)
    green = sigmoid(tl.sum(hidden * weights[1][None, :], 1) + biases[1], HALF)
    blue = sigmoid(tl.sum(hidden * weights[2][None, :], 1) + biases[2], HALF)
    density = softplus(tl.sum(hidden * weights[3][None, :], 1) + biases[3] + shift, HALF) * (scale * frame[1])
    return red, green, blue, tl.where(valid, density, 0.0)
