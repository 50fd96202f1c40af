"""Sofas, stools and poufs, beds, rugs."""

from dataclasses import replace

import numpy as np

from procedural.chair_parts import FABRICS, bar, draw_colour
from procedural.mesh import Part, box, tube
from procedural.paint import jitter, pick
from procedural.products.materials import Material, fabric, metal, wood
from procedural.products.pieces import GREY, corner_legs, leaning, pillow, shifted
from procedural.texture import Texture


def sofa(rng: np.random.Generator) -> list[Part]:
    """Base, arms, back, two or three cushions, feet, perhaps a chaise and pillows."""
    width, depth = float(rng.uniform(1.35, 2.2)), float(rng.uniform(0.80, 0.95))
    seat, top = float(rng.uniform(0.40, 0.46)), float(rng.uniform(0.72, 0.90))
    arm, arm_top = float(rng.uniform(0.08, 0.22)), float(rng.uniform(0.54, 0.66))
    foot, back = float(rng.uniform(0.05, 0.16)), float(rng.uniform(0.16, 0.24))
    cover, legs = fabric(rng), wood(rng) if rng.random() < 0.7 else metal(rng)
    cushions = cover if rng.random() < 0.7 else fabric(rng)
    base_top, inner = seat - 0.13, width - 2 * arm
    frame = [
        box("base", (0, 0, (foot + base_top) / 2), (width - 0.02, depth - 0.02, base_top - foot), GREY, bevel=0.02)
    ]
    tall = top - foot - 0.04
    frame.append(box("back", (0, (depth - back) / 2, foot + tall / 2), (width, back, tall), GREY, bevel=0.04))
    for s in (-1, 1):
        size = (arm, depth, arm_top - foot)
        frame.append(box("arm", (s * (width - arm) / 2, 0, (foot + arm_top) / 2), size, GREY, bevel=0.04))
    count = 2 if width < 1.6 else 3
    each, soft = inner / count, []
    chaise = rng.random() < 0.3
    for k in range(count):
        x = -inner / 2 + (k + 0.5) * each
        reach = depth - back + (0.55 if chaise and k == 0 else 0.0)
        y = depth / 2 - back - reach / 2
        soft.append(box("cushion", (x, y, base_top + 0.065), (each - 0.01, reach, 0.14), GREY, bevel=0.04))
        if chaise and k == 0:
            block = (each - 0.01, 0.56, base_top - foot)
            frame.append(box("chaise", (x, -depth / 2 - 0.26, (foot + base_top) / 2), block, GREY, bevel=0.02))
        high = top - seat + 0.03
        upright = box(
            "back_cushion", (x, depth / 2 - back - 0.06, seat + high / 2), (each - 0.02, 0.14, high), GREY, bevel=0.05
        )
        soft.append(leaning(upright, seat, 0.15))
    parts = cover.on(frame) + cushions.on(soft)
    if rng.random() < 0.6:
        accent = fabric(rng)
        for s in (-1, 1) if rng.random() < 0.6 else (1,):
            side = float(rng.uniform(0.36, 0.44))
            cushion = pillow(
                "pillow", (s * (inner / 2 - 0.22), depth / 2 - back - 0.26, seat + side / 2), (side, 0.16, side)
            )
            parts += accent.on([leaning(cushion, seat, 0.3)])
    feet = corner_legs("foot", (width / 2 - 0.08, depth / 2 - 0.08), foot + 0.02, 0.045, 0.02)
    return parts + legs.on(feet)


def stool(rng: np.random.Generator) -> list[Part]:
    """A pouf, a padded ottoman, or a wooden stool."""
    kind = pick(rng, {"pouf": 1, "ottoman": 1.2, "wooden": 1.2})
    if kind == "pouf":
        radius, tall = float(rng.uniform(0.22, 0.32)), float(rng.uniform(0.32, 0.42))
        profile = [0.75, 0.93, 1.0, 1.0, 0.93, 0.72]
        body = tube(
            "pouf",
            (0, 0, 0),
            (0, 0, tall),
            [radius * r for r in profile],
            GREY,
            segments=32,
            positions=[0, 0.12, 0.35, 0.65, 0.88, 1],
        )
        return fabric(rng).on([body])
    if kind == "ottoman":
        w, d = float(rng.uniform(0.45, 0.95)), float(rng.uniform(0.40, 0.55))
        foot, tall = float(rng.uniform(0.10, 0.22)), float(rng.uniform(0.40, 0.46))
        pad = box("seat", (0, 0, (foot + tall) / 2), (w, d, tall - foot), GREY, bevel=0.04)
        feet = corner_legs("leg", (w / 2 - 0.06, d / 2 - 0.06), foot + 0.02, 0.04, 0.02, 0.6)
        return fabric(rng).on([pad]) + wood(rng).on(feet)
    tall, radius = float(rng.uniform(0.42, 0.68)), float(rng.uniform(0.15, 0.19))
    seat = tube("seat", (0, 0, tall - 0.04), (0, 0, tall), [radius, radius, 0.93 * radius], GREY, segments=32)
    count, turn = int(rng.integers(3, 5)), float(rng.uniform(0, np.pi))
    legs, rungs = [], []
    for k in range(count):
        c, s = (f(turn + 2 * np.pi * k / count) for f in (np.cos, np.sin))
        head, foot_at = (
            np.array([0.65 * radius * c, 0.65 * radius * s, tall - 0.02]),
            np.array([1.2 * radius * c, 1.2 * radius * s, 0]),
        )
        legs.append(bar("leg", head, foot_at, 0.034, GREY, True, 0.75))
        rungs.append(0.6 * foot_at + 0.4 * head)
    rungs = [bar("rung", a, b, 0.02, GREY) for a, b in zip(rungs, rungs[1:] + rungs[:1], strict=True)]
    timber = wood(rng)
    return (timber if rng.random() < 0.7 else wood(rng)).on([seat]) + timber.on(legs + rungs)


def bed(rng: np.random.Generator) -> list[Part]:
    """A frame with a headboard at +y, mattress, duvet folded back, pillows."""
    width, length = float(rng.uniform(0.95, 1.8)), float(rng.uniform(1.95, 2.1))
    rail, top = float(rng.uniform(0.28, 0.36)), float(rng.uniform(0.85, 1.2))
    padded = rng.random() < 0.4
    frame = fabric(rng) if padded else wood(rng)
    clear, y = float(rng.uniform(0.08, 0.16)), length / 2
    structure = [
        box("frame", (0, 0, (clear + rail) / 2), (width + 0.08, length + 0.06, rail - clear), GREY, bevel=0.015)
    ]
    if padded or rng.random() < 0.6:
        size = (width + 0.10, 0.10 if padded else 0.05, top)
        structure.append(box("headboard", (0, y + 0.05, top / 2), size, GREY, bevel=0.03 if padded else 0.008))
    else:
        for x in (-width / 2 - 0.02, width / 2 + 0.02):
            structure.append(bar("post", (x, y + 0.04, 0), (x, y + 0.04, top), 0.06, GREY, False))
        structure.append(box("crest", (0, y + 0.04, top - 0.06), (width, 0.04, 0.10), GREY))
        for x in np.linspace(-0.85, 0.85, 7) * width / 2:
            structure.append(bar("slat", (x, y + 0.04, rail), (x, y + 0.04, top - 0.05), 0.03, GREY))
    feet = corner_legs("foot", (width / 2, y - 0.05), clear + 0.02, 0.06, 0, 1.0, False)
    white = Material(jitter(rng, (0.90, 0.89, 0.87), 0.02))
    mattress = box("mattress", (0, 0, rail + 0.08), (width, length, 0.20), GREY, bevel=0.04)
    covered = float(rng.uniform(0.60, 0.75)) * length
    level = rail + 0.115
    duvet = box(
        "duvet", (0, -(length - covered) / 2 - 0.01, level), (width + 0.05, covered + 0.02, 0.20), GREY, bevel=0.05
    )
    count = 1 if width < 1.2 else 2
    pillows = []
    for k in range(count):
        x = (k - (count - 1) / 2) * width / 2
        flat = pillow("pillow", (0, 0, 0), (0.8 * width / count, 0.14, 0.42))
        lying = replace(flat, vertices=flat.vertices[:, [0, 2, 1]], faces=flat.faces[:, ::-1])
        pillows.append(shifted(lying, (x, y - 0.27, rail + 0.23)))
    timber = frame if not padded else wood(rng)
    return [*frame.on(structure), *timber.on(feet), *white.on([mattress, *pillows]), *fabric(rng).on([duvet])]


def rug(rng: np.random.Generator) -> list[Part]:
    """A thin carpet, rectangular or round, with a border or stripes."""
    colour, second = draw_colour(rng, FABRICS), draw_colour(rng, FABRICS)
    while abs(np.mean(colour) - np.mean(second)) < 0.15:
        second = draw_colour(rng, FABRICS)
    thick = float(rng.uniform(0.02, 0.035))
    pattern = pick(rng, {"bordered": 3, "stripes": 1, "checks": 1})
    size = (0.0, 0.0) if pattern == "bordered" else (float(rng.uniform(0.25, 0.5)),) * 2
    cover = Material(colour, "matte", Texture(pattern, second, size, int(rng.integers(2**16))))
    if rng.random() < 0.25:
        radius = float(rng.uniform(0.6, 0.9))
        body = tube("rug", (0, 0, 0), (0, 0, thick), [radius, radius], GREY, segments=48)
    else:
        body = box("rug", (0, 0, thick / 2), (float(rng.uniform(0.8, 1.3)), float(rng.uniform(1.4, 2.0)), thick), GREY)
    return cover.on([body])
