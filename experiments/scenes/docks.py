"""The docks: a medieval quay with moored ships, half-timbered houses, a crane, stalls and glossy water.

Runs inside Blender (bpy 5.0), standard library otherwise. `build` fills an emptied file; the render core adds
passes and settings. x runs along the quay, water is y < 0, houses y > 10, z is up, metres. Every clip is
another town: placement, camera and phases come from (seed, split, clip) alone. Moving things are rigid
key-frames or shape keys on frames 0..frames+1.
"""

import math
import random
import sys
from pathlib import Path

import bpy
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
from docks_fleet import (
    add_bunting,
    add_cart,
    add_crane,
    add_flag,
    add_gull,
    add_person,
    add_rowboat,
    add_ship,
    walk,
)
from docks_kit import Mesh, add_light, keyed, place, shift
from docks_town import add_coil, add_goods, add_lamp, add_quay, add_stall, add_town, add_water

SETTINGS = {
    "test_samples": 64,
    "train_samples": 20,
    "denoise": False,
    "max_bounces": 3,
    "diffuse_bounces": 0,
    "glossy_bounces": 2,
    "exposure": 1.0,
}


def _path(style, rng, split):
    """Where the camera starts and ends, and what it looks at there, for one style of shot."""
    x = rng.uniform(-26, -6) if split == "train" else rng.uniform(12, 26)
    if style == "along":  # down the quay with the sun ahead
        a = Vector((x, rng.uniform(3.6, 4.6), rng.uniform(2.3, 2.9)))
        return a, a + Vector((2.2, -0.5, 0.1)), a + Vector((11, -4.4, -0.3)), a + Vector((13, -3.4, 0.0))
    if style == "masts":  # over the edge, panning past masts
        a = Vector((x, rng.uniform(2.4, 3.4), 3.0))
        return a, a + Vector((1.3, 0.1, 0.25)), a + Vector((7.5, -9, 0.1)), a + Vector((11.0, -7.4, 0.3))
    if style == "lane":  # out of a lane towards the ships
        a = Vector((x, 15.2, 1.75))
        return a, a + Vector((0.15, -2.6, 0.05)), a + Vector((-0.6, -10, 0.2)), a + Vector((1.5, -12, 0.5))
    if style == "water":  # from a boat, houses in the sun
        a = Vector((x, rng.uniform(-15.5, -14), rng.uniform(0.5, 1.2)))
        return a, a + Vector((2.0, 0.5, 0.1)), a + Vector((5, 14, 0.6)), a + Vector((9, 14, 0.9))
    if style == "back":  # away from the sun, backing out
        a = Vector((x + 8, rng.uniform(3.6, 4.8), rng.uniform(2.4, 3.0)))
        return a, a + Vector((1.7, 0.1, 0.25)), a + Vector((-11, -3.2, -0.5)), a + Vector((-10, -1.6, -0.3))
    a = Vector((x, 1.2, rng.uniform(3.0, 3.8)))  # "rise": up over the moorings
    return a, a + Vector((0.9, 0.6, 1.9)), a + Vector((9.5, -2.6, -1.6)), a + Vector((11, -0.8, -1.2))


STYLES = {
    "train": ("along", "water", "back", "masts", "lane", "rise"),
    "test": ("along", "water", "rise", "back", "lane", "masts"),
}


def _camera(rng, frames, line):
    a, b, look_a, look_b = line
    data = bpy.data.cameras.new("camera")
    data.lens, data.sensor_width, data.clip_end = rng.uniform(25, 29), 36.0, 2000.0
    camera = place(data, "camera")
    bpy.context.scene.camera = camera
    phase = rng.uniform(0, 6)

    def pose(f):
        t = f / frames
        eye = a.lerp(b, t) + Vector((0, 0, 0.015 * math.sin(0.5 * f + phase)))
        turn = (look_a.lerp(look_b, t) - eye).to_track_quat("-Z", "Y").to_euler()
        return eye, (turn.x, turn.y + 0.004 * math.sin(0.23 * f + phase), turn.z)

    keyed(camera, frames, pose)


def build(*, seed: int, split: str, clip: int, frames: int) -> None:
    """Build clip `clip` of `split` ("train" or "test") into an emptied file, keyed on frames 0..frames+1."""
    if split not in STYLES:
        raise ValueError(f"docks: split must be one of {sorted(STYLES)}, got {split!r}")
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    rng = random.Random(f"docks/{seed}/{split}/{clip}")
    style, time = STYLES[split][clip % 6], rng.uniform(0, 100)
    line = _path(style, rng, split)
    eye, end = line[0], line[1]
    taken = [(eye.lerp(end, k / 4).x, eye.lerp(end, k / 4).y, 1.5) for k in range(5)]

    def free(x, y, r):
        return all(math.hypot(x - a, y - b) > r + c for a, b, c in taken)

    add_light(rng)
    lane = eye.x + 0.07 if style == "lane" else eye.x + rng.uniform(12, 20)
    add_town(rng, lane)
    pier_x, slots, x = [], [], eye.x - 27 + rng.uniform(-2, 2)
    while x < eye.x + 40:  # ships along the quay, now and then a pier between two
        length = rng.uniform(10.5, 14.5)
        slots.append((x + length / 2 + 1.6, length))
        x += length + 4.2
        if rng.random() < 0.6 and abs(x - eye.x) > 3:
            pier_x.append(x + 1.2)
            x += 3.4
    boats = (eye.x + rng.uniform(7, 12), eye.x + rng.uniform(-14, -6))
    posts = add_quay(rng, [p for p in pier_x if all(abs(p - b) > 5 for b in boats)])
    add_water(rng, frames, time)
    for x, length in slots:
        y = -length * 0.15 - 1.0
        if style == "water" and abs(x - eye.x) < 5 and eye.y > y - 6:
            continue
        turn = rng.choice((0.0, math.pi)) + rng.uniform(-0.03, 0.03)
        facing = 1 if math.cos(turn) > 0 else -1
        ropes = []
        for t in (0.10, 0.90):
            at = x + facing * (t - 0.5) * length
            post = min(
                posts,
                key=lambda p, at=at, t=t, facing=facing: abs(p - at - 2.2 * facing * (1 if t > 0.5 else -1)),
            )
            ropes.append(((post, -0.3, 0.6), t, facing))
        add_ship(rng, x, y, turn, frames, time, length, ropes)
    for k in range(4):  # ships at anchor
        x, y = eye.x - 22 + 17 * k + rng.uniform(-4, 4), rng.uniform(-34, -22)
        add_ship(rng, x, y, rng.uniform(0, 6.28), frames, time, rng.uniform(10, 14))
    boat_y = -10.5 if style != "water" else -8.8
    add_rowboat(rng, boats[0], boat_y, rng.choice((0.15, 3.0)), rng.uniform(0.07, 0.11), frames, time)
    add_rowboat(rng, boats[1], -11.5, rng.choice((-0.15, 3.3)), rng.uniform(0.06, 0.10), frames, time)

    back = -1 if style == "back" else 1
    movers = [(eye.x + back * rng.uniform(6.5, 9.0), 7.4), (eye.x + rng.uniform(12, 20), 6.4)]
    for (x, y), heading in zip(movers, (rng.choice((0.05, 3.2)), 3.1), strict=True):
        add_cart(rng, x, y, heading, rng.uniform(0.045, 0.07), frames)
        taken += [(x + d, y, 0.8) for d in (-3, -2, -1, 0, 1, 2, 3)]
    for near in (eye.x + back * rng.uniform(11, 17), eye.x - back * 14):
        depth = rng.uniform(1.5, 2.1)
        add_crane(rng, near, depth, frames, time)
        taken.append((near, depth, 1.6))
    for k in range(4):
        x = eye.x - 20 + 11 * k + rng.uniform(-2, 2)
        y = 8.2
        if free(x, y, 1.9) and abs(x - lane) > 3:
            add_stall(rng, x, y, frames, time)
            taken.append((x, y, 1.9))
    for _ in range(11):
        x, y = eye.x + rng.uniform(-18, 22), rng.uniform(2.6, 8.2)
        if free(x, y, 2.2):
            walk(
                add_person(rng),
                frames,
                x,
                y,
                rng.choice((0.0, 3.14)) + rng.uniform(-0.5, 0.5),
                rng.uniform(0.03, 0.055),
                rng.uniform(0, 6),
            )
            taken.append((x, y, 0.5))
    goods = Mesh(rng)
    for _ in range(60):
        x, y = (
            eye.x + rng.uniform(-26, 30),
            rng.choice((rng.uniform(0.9, 2.6), rng.uniform(0.9, 4.0), rng.uniform(8.4, 9.2))),
        )
        if free(x, y, 0.95):
            goods.at = shift(x, y, 0, rng.uniform(0, 6.28))
            add_coil(goods) if rng.random() < 0.2 else add_goods(goods, rng)
            taken.append((x, y, 0.95))
    for k in range(9):
        x = eye.x - 28 + 7.5 * k
        if free(x, 5.6, 0.3):
            goods.at = shift(x, 5.6)
            add_lamp(goods)
    goods.object("goods")
    for k in range(5):
        x = eye.x - 18 + 9 * k + rng.uniform(-1, 1)
        if style == "lane" and abs(x - lane) < 2.5:
            continue
        pole = Mesh(rng, shift(x, 9.3))
        pole.tube([(0, 0, 0), (0, 0, 5.4)], [0.07, 0.04], "mast", 8)
        pole.object("pole")
        add_flag(
            rng,
            None,
            shift(x, 9.3, 5.3, 0.9),
            1.7,
            0.8,
            frames,
            time,
            rng.choice(["red", "blue", "yellow", "awning_red", "awning_blue"]),
        )
        if k < 4 and style != "lane":
            add_bunting(rng, (x, 9.3, 4.3), (x + 9, 9.3, 4.4), frames, time)
    if style == "lane":
        for y in (10.4, 12.6):
            add_bunting(rng, (lane - 1.6, y, 4.4), (lane + 1.6, y + 0.4, 4.6), frames, time)
    for _ in range(9):
        side = Vector((rng.uniform(-8, 16), rng.uniform(-15, 4), rng.uniform(4.5, 9.5)))
        if style == "water":
            side.y += 16
        add_gull(rng, Vector((eye.x, 0, 0)) + side, frames)
    _camera(rng, frames, line)
