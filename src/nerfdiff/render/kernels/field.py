"""Device code of a triplane field: ξ_W(x) and f_θ at a column of points."""

from typing import no_type_check

import triton
import triton.language as tl


@triton.jit
@no_type_check
def frustum(scene, K, near, far, width, height):
    """t_n, 1 / (t_f − t_n), and the intrinsics in units of the image's size."""
    start, end = tl.load(near + scene), tl.load(far + scene)
    fx, cx = tl.load(K + scene * 9) / width, tl.load(K + scene * 9 + 2) / width
    fy, cy = tl.load(K + scene * 9 + 4) / height, tl.load(K + scene * 9 + 5) / height
    return start, 1.0 / (end - start), fx, cx, fy, cy


@triton.jit
@no_type_check
def unit_coordinates(x, y, z, start, inverse_extent, fx, cx, fy, cy):
    """x̃ scaled to [0, 1]³ inside the frustum, and whether the point lies beyond the near plane.

    As `Triplane.frustum_coordinates`: what lies before t_n is put in the middle, and counts for nothing.
    """
    valid = z >= start
    inverse = 1.0 / tl.where(valid, z, 1.0)
    u = tl.where(valid, fx * x * inverse + cx, 0.5)
    v = tl.where(valid, fy * y * inverse + cy, 0.5)
    w = tl.where(valid, (z - start) * inverse_extent, 0.5)
    return u, v, w, valid


@triton.jit
@no_type_check
def texel(unit, size):
    """The two texels around a coordinate, how far the second is on the way, and where there is a slope.

    Borders repeat. Comparisons are written so that a NaN ends at the first texel, never outside the plane.
    """
    position = unit * size - 0.5
    last = (size - 1) * 1.0
    sloped = (position > 0.0) & (position < last)
    position = tl.where(position > 0.0, tl.where(position < last, position, last), 0.0)
    first = position.to(tl.int32)
    return first, tl.minimum(first + 1, size - 1), position - first.to(tl.float32), sloped


@triton.jit
@no_type_check
def corner(plane, row, column, width, channel, C: tl.constexpr):
    """Features of one texel per point, fp32."""
    at = (row * width + column) * C
    return tl.load(plane + at[:, None] + channel[None, :], mask=channel[None, :] < C, other=0.0).to(tl.float32)


@triton.jit
@no_type_check
def axes(plane, u, v, w):
    """The coordinates along (rows, columns) of W_xy, W_xz or W_yz, whose columns run along x, x and z."""
    return tl.where(plane == 1, w, v), tl.where(plane == 2, w, u)


@triton.jit
@no_type_check
def features(planes, u, v, w, height, width, channel, C: tl.constexpr):
    """W_xy + W_xz + W_yz at points: bilinear, [points, channels].

    A loop, and no three copies: all twelve gathers at once would need more registers than there are.
    """
    found = tl.zeros([u.shape[0], channel.shape[0]], tl.float32)
    for plane in range(3):
        along_rows, along_columns = axes(plane, u, v, w)
        r0, r1, fr, _ = texel(along_rows, height)
        c0, c1, fc, _ = texel(along_columns, width)
        at = planes + plane * height * width * C
        found += corner(at, r0, c0, width, channel, C) * ((1.0 - fr) * (1.0 - fc))[:, None]
        found += corner(at, r0, c1, width, channel, C) * ((1.0 - fr) * fc)[:, None]
        found += corner(at, r1, c0, width, channel, C) * (fr * (1.0 - fc))[:, None]
        found += corner(at, r1, c1, width, channel, C) * (fr * fc)[:, None]
    return found


@triton.jit
@no_type_check
def operand(x, PRECISION: tl.constexpr):
    """What a product sees of x. `rounded` gives bf16's numbers where there is no bf16 arithmetic (interpreter)."""
    if PRECISION == "bf16":
        return x.to(tl.bfloat16)
    elif PRECISION == "rounded":
        return x.to(tl.bfloat16).to(tl.float32)
    else:
        return x


@triton.jit
@no_type_check
def dot(a, b, PRECISION: tl.constexpr):
    """A product of operands, with fp32 sums."""
    if PRECISION == "bf16":
        return tl.dot(a, b)
    elif PRECISION == "rounded":
        return tl.dot(a, b, input_precision="ieee")
    else:
        return tl.dot(a, b, input_precision=PRECISION)


@triton.jit
@no_type_check
def first_layer(weight, bias, C: tl.constexpr, HIDDEN: tl.constexpr, CP: tl.constexpr, HP: tl.constexpr):
    """The hidden layer's weight as [channels, hidden] and its bias, padded with zeros."""
    channel, unit = tl.arange(0, CP), tl.arange(0, HP)
    inside = (channel[:, None] < C) & (unit[None, :] < HIDDEN)
    w1 = tl.load(weight + unit[None, :] * C + channel[:, None], mask=inside, other=0.0)
    return w1.to(tl.float32), tl.load(bias + unit, mask=unit < HIDDEN, other=0.0).to(tl.float32)


@triton.jit
@no_type_check
def second_layer(weight, bias, HIDDEN: tl.constexpr, HP: tl.constexpr):
    """The output layer's weight as [hidden, 16] and its bias: red, green, blue, density, and zeros.

    A product's sides are at least 16 long.
    """
    unit, k = tl.arange(0, HP), tl.arange(0, 16)
    inside = (unit[:, None] < HIDDEN) & (k[None, :] < 4)
    w2 = tl.load(weight + k[None, :] * HIDDEN + unit[:, None], mask=inside, other=0.0)
    return w2.to(tl.float32), tl.load(bias + k, mask=k < 4, other=0.0).to(tl.float32)


@triton.jit
@no_type_check
def column(outputs, k: tl.constexpr):
    """One of the 16 columns of what the output layer says of points."""
    return tl.sum(tl.where(tl.arange(0, 16)[None, :] == k, outputs, 0.0), 1)


@triton.jit
@no_type_check
def columns(red, green, blue, density):
    """The inverse of `column`: four quantities of points side by side, [points, 16]."""
    k = tl.arange(0, 16)[None, :]
    second = tl.where(k == 2, blue[:, None], tl.where(k == 3, density[:, None], 0.0))
    return tl.where(k == 0, red[:, None], tl.where(k == 1, green[:, None], second))


@triton.jit
@no_type_check
def softplus(x):
    """log(1 + eˣ), accurate where it is tiny as well (Kahan's log1p)."""
    e = tl.exp(-tl.abs(x))
    one_more = 1.0 + e
    tiny = one_more == 1.0
    return tl.maximum(x, 0.0) + tl.where(tiny, e, tl.log(one_more) * (e / tl.where(tiny, 1.0, one_more - 1.0)))


@triton.jit
@no_type_check
def scene_field(
    scene, planes, K, near, far, w1, b1, w2, b2, image_width, image_height, height, width,
    SHARED: tl.constexpr, PRECISION: tl.constexpr, C: tl.constexpr, HIDDEN: tl.constexpr, CP: tl.constexpr,
    HP: tl.constexpr,
):  # fmt: skip
    """What a program reads of a scene's field before its first point: planes, `frustum`, and layers as operands."""
    own = 0 if SHARED else scene
    hidden_w, hidden_b = first_layer(w1 + own * HIDDEN * C, b1 + own * HIDDEN, C, HIDDEN, CP, HP)
    output_w, output_b = second_layer(w2 + own * 4 * HIDDEN, b2 + own * 4, HIDDEN, HP)
    layers = operand(hidden_w, PRECISION), hidden_b, operand(output_w, PRECISION), output_b
    frame = frustum(scene, K, near, far, image_width, image_height)
    return planes + scene * 3 * height * width * C, frame, layers


@triton.jit
@no_type_check
def query(
    planes, x, y, z, frame, layers, shift, scale, height, width, C: tl.constexpr, CP: tl.constexpr,
    PRECISION: tl.constexpr,
):  # fmt: skip
    """f_θ(ξ_W(x)) at points: the output layer's 16 columns and density per scene unit, and how they came about.

    Returns:
        outputs [points, 16]; density [points]; (u, v, w, valid) of `unit_coordinates`; and
        (features, hidden layer before its activation, the activation's gate, hidden layer). What a kernel has no use
        for is not computed: the compiler drops it.
    """
    start, inverse_extent, fx, cx, fy, cy = frame
    hidden_w, hidden_b, output_w, output_b = layers
    u, v, w, valid = unit_coordinates(x, y, z, start, inverse_extent, fx, cx, fy, cy)
    found = operand(features(planes, u, v, w, height, width, tl.arange(0, CP), C), PRECISION)
    pre = dot(found, hidden_w, PRECISION) + hidden_b[None, :]
    gate = tl.sigmoid(pre)
    hidden = operand(pre * gate, PRECISION)
    outputs = dot(hidden, output_w, PRECISION) + output_b[None, :]
    density = tl.where(valid, softplus(column(outputs, 3) + shift) * scale * inverse_extent, 0.0)
    return outputs, density, (u, v, w, valid), (found, pre, gate, hidden)
