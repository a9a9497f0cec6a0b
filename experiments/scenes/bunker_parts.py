"""What fills the bunker's rooms and stands still: gratings, pipes with valves, cables, props and lamps.

Every function builds one thing at a place of the world (metres, z up) into the `Place` under construction.
Only valve wheels and the flickering lamp are animated. Machines: bunker_machines.py.
"""

import math
import random
import sys
from itertools import pairwise
from pathlib import Path

from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common as co
from bunker_kit import Part, bend, sign, spin

WARM, COLD = (1.0, 0.80, 0.55), (0.78, 0.90, 1.0)


class Place:
    """The scene under construction: materials, random numbers, camera path and what stands where."""

    def __init__(self, mats: dict, rng: random.Random, path: list[Vector], frames: int):
        self.mats, self.rng, self.path, self.frames = mats, rng, path, frames
        self.taken: list[tuple[float, float, float]] = []

    def part(self) -> Part:
        return Part(self.mats)

    def free(self, x: float, y: float, radius: float, clear: float = 0.75, low: bool = True) -> bool:
        """Whether a disc on the floor is clear of the camera's path and of what stands; then take it."""
        near = (
            min(math.hypot(p.x - x, p.y - y) for p in self.path if not low or p.z < 3)
            if self.low(low)
            else 99
        )
        if near < radius + clear or any(math.hypot(a - x, b - y) < r + radius for a, b, r in self.taken):
            return False
        self.taken.append((x, y, radius))
        return True

    def low(self, low: bool) -> bool:
        return not low or any(p.z < 3 for p in self.path)


def grating(
    p: Place, x0: float, x1: float, y0: float, y1: float, z: float, name: str, pitch: float = 0.085
) -> None:
    """Bearing bars along y, cross bars and an edge frame; one looks through it."""
    g = p.part()
    count = int((x1 - x0) / pitch)
    for i in range(count + 1):
        x = x0 + (x1 - x0) * i / count
        g.box((x - 0.011, y0, z - 0.05), (x + 0.011, y1, z), "steel")
    bars = int((y1 - y0) / 0.34)
    for i in range(bars + 1):
        y = y0 + (y1 - y0) * i / bars
        g.box((x0, y - 0.012, z - 0.028), (x1, y + 0.012, z - 0.004), "steel")
    for x in (x0, x1):
        g.box((x - 0.035, y0, z - 0.07), (x + 0.035, y1, z + 0.006), "yellow_line")
    g.object(name)


# --- pipes ----------------------------------------------------------------------------------------------


def pipe(
    p: Place, points: list, radius: float, mat: str, flange: float = 2.2, flange_mat: str = "steel"
) -> None:
    """A pipe with rounded corners and bolted flanges along its straight runs."""
    g = p.part()
    g.tube(bend(points, max(2.2 * radius, 0.12)), radius, mat, 16)
    for a, b in pairwise(points):
        a, b = Vector(a), Vector(b)
        length, way = (b - a).length, (b - a).normalized()
        for i in range(int(length / flange)):
            at = a + way * (flange * (i + 0.5))
            for gap in (-0.035, 0.035):
                g.rod(
                    at + way * (gap - 0.022), at + way * (gap + 0.022), radius * 1.55 + 0.01, flange_mat, 16
                )
            g.rod(at - way * 0.22, at - way * 0.16, radius * 1.1, "dark", 16)
    g.object("pipe")


def valve(p: Place, at: tuple, axis: str, radius: float, mat: str = "red", rate: float = 0.0) -> None:
    """A valve body with a stem and a hand wheel facing along `axis` ("X", "-X", "Y", "-Y", "Z")."""
    way = {"X": (1, 0, 0), "-X": (-1, 0, 0), "Y": (0, 1, 0), "-Y": (0, -1, 0), "Z": (0, 0, 1)}[axis]
    centre, way = Vector(at), Vector(way)
    body = p.part()
    body.rod(centre - way * radius * 1.3, centre + way * radius * 1.9, radius * 1.25, "dark", 14)
    body.rod(centre + way * radius * 1.9, centre + way * (radius * 1.9 + 0.20), 0.022, "brass", 8)
    body.object("valve")
    wheel = p.part()
    size = max(0.15, radius * 1.4)
    wheel.ring((0, 0, 0), "Z", size, 0.024, mat)
    for i in range(5):
        angle = math.tau * i / 5
        wheel.rod((0, 0, 0), (size * math.cos(angle), size * math.sin(angle), 0), 0.014, mat, 6)
    wheel.rod((0, 0, -0.03), (0, 0, 0.04), 0.04, mat, 10)
    ob = wheel.object("valve_wheel")
    turn = way.to_track_quat("Z", "Y").to_matrix().to_4x4()
    base = Matrix.Translation(centre + way * (radius * 1.9 + 0.19)) @ turn
    ob.matrix_world = base
    if rate:
        spin(ob, p.frames, base, "Z", lambda f: rate * f)


def pipe_rack(p: Place, x: float, y0: float, y1: float, top: float, face: int) -> None:
    """Parallel pipes along y on a wall at `x`, facing `face` (+1: +x), with valves and brackets."""
    rng, z = p.rng, 0.42
    axis = "X" if face > 0 else "-X"
    rows = [("teal", 0.15), ("steel", 0.075), ("copper", 0.055), ("red", 0.085), ("rusty", 0.11)]
    rows += [("white", 0.07), ("yellow", 0.06), ("steel", 0.10)]
    rng.shuffle(rows)
    row = 0
    while z < top and row < len(rows):
        mat, radius = rows[row]
        out = x + face * (radius + 0.10)
        pipe(p, [(out, y0, z), (out, y1, z)], radius, mat, flange=rng.uniform(1.8, 3.0))
        y = y0 + rng.uniform(0.6, 2.0)
        while y < y1 - 0.6 and radius > 0.07:
            valve(p, (out, y, z), axis, radius, rng.choice(("red", "red", "yellow", "blue")))
            y += rng.uniform(2.2, 4.0)
        z += radius + rng.uniform(0.24, 0.34)
        row += 1
    b = p.part()
    y = y0 + 0.5
    while y < y1:
        b.box(
            (min(x, x + face * 0.07), y - 0.035, 0.25), (max(x, x + face * 0.07), y + 0.035, z + 0.1), "dark"
        )
        y += 2.4
    b.object("brackets")


def cables(p: Place, a: tuple, b: tuple, count: int) -> None:
    """Cables sagging between hooks from a to b."""
    g = p.part()
    a, b = Vector(a), Vector(b)
    spans = max(2, int((b - a).length / 2.2))
    side = (b - a).normalized().cross(Vector((0, 0, 1)))
    for number in range(count):
        mat = p.rng.choice(("rubber", "rubber", "dark", "orange", "blue"))
        sag, shift = p.rng.uniform(0.05, 0.2), side * (0.05 * number)
        steps = spans * 6
        points = []
        for i in range(steps + 1):
            t = i / steps
            hang = 4 * ((t * spans) % 1) * (1 - (t * spans) % 1)
            points.append(a.lerp(b, t) + shift - Vector((0, 0, sag * hang)))
        g.tube(points, p.rng.uniform(0.014, 0.024), mat, 6)
    g.object("cables")


def tray(p: Place, x: float, y0: float, y1: float, z: float) -> None:
    """Cable ladder along y under the ceiling with cables in it."""
    g = p.part()
    for dx in (-0.2, 0.2):
        g.box((x + dx - 0.015, y0, z), (x + dx + 0.015, y1, z + 0.08), "galvanised")
    y = y0
    while y < y1:
        g.box((x - 0.2, y, z), (x + 0.2, y + 0.03, z + 0.02), "galvanised")
        y += 0.3
    for i, mat in enumerate(("rubber", "dark", "orange", "rubber")):
        g.rod((x - 0.14 + 0.09 * i, y0, z + 0.045), (x - 0.14 + 0.09 * i, y1, z + 0.045), 0.025, mat, 6)
    g.object("tray")


# --- props ----------------------------------------------------------------------------------------------


def crate(p: Place, x: float, y: float, size: float, yaw: float, z: float = 0.0) -> None:
    g, h = p.part(), size / 2
    body, frame = p.rng.choice(
        (("wood", "wood"), ("wood_green", "wood_green"), ("plate", "yellow"), ("blue", "steel"))
    )
    g.box((-h + 0.03, -h + 0.03, 0.03), (h - 0.03, h - 0.03, size - 0.03), body)
    w = 0.075
    for a in (-h, h - w):
        for b in (-h, h - w):
            g.box((a, b, 0), (a + w, b + w, size), frame)
            g.box((a, -h, b + h), (a + w, h, b + h + w), frame)
            g.box((-h, a, b + h), (h, a + w, b + h + w), frame)
    g.object("crate", (x, y, z), yaw)


def barrel(p: Place, x: float, y: float, z: float = 0.0) -> None:
    g = p.part()
    mat = p.rng.choice(("teal", "red", "yellow", "blue", "rusty", "green"))
    r = 0.29
    profile = [
        (r, 0),
        (r, 0.28),
        (r + 0.02, 0.30),
        (r, 0.32),
        (r, 0.58),
        (r + 0.02, 0.60),
        (r, 0.62),
        (r, 0.88),
    ]
    g.tube([(0, 0, h) for _, h in profile], [q for q, _ in profile], mat, 20)
    g.ring((0, 0, 0.88), "Z", r, 0.018, mat, 20, 6)
    g.rod((0, 0, 0.44), (0, 0, 0.53), r + 0.004, p.rng.choice(("stripes", "white_line", "stripes_red")), 20)
    g.rod((0.15, 0.05, 0.87), (0.15, 0.05, 0.905), 0.04, "steel", 8)
    g.object("barrel", (x, y, z), p.rng.uniform(0, 6))


def door(p: Place, x: float, y: float, face: tuple[float, float], mat: str, text: str) -> None:
    """A steel door in a wall; `face` is the direction into the room."""
    yaw = math.atan2(-face[0], face[1])  # local +y is into the room
    g = p.part()
    g.box((-0.62, 0, 0), (0.62, 0.10, 2.3), "dark")
    g.box((-0.52, 0.02, 0.05), (0.52, 0.14, 2.2), mat)
    for low, high in ((0.2, 0.95), (1.15, 1.55)):
        g.box((-0.40, 0.13, low), (0.40, 0.165, high), mat)
    g.box((-0.2, 0.13, 1.66), (0.2, 0.17, 1.98), "dark")
    for z in (0.3, 1.1, 1.9):
        g.rod((-0.55, 0.15, z - 0.09), (-0.55, 0.15, z + 0.09), 0.035, "steel", 8)
    g.rod((0.40, 0.20, 0.95), (0.40, 0.20, 1.25), 0.022, "chrome", 8)
    g.box((-0.52, 0.141, 0.05), (0.52, 0.150, 0.19), "stripes")
    g.box((-0.14, 0.0, 2.36), (0.14, 0.1, 2.46), p.rng.choice(("lamp_red", "lamp_green")))
    g.object("door", (x, y, 0), yaw)
    at = (x + face[0] * 0.17, y + face[1] * 0.17, 1.35)
    sign(text, 0.26, p.mats["white"], at, (math.pi / 2, 0, math.atan2(face[0], -face[1])))


def panel(p: Place, x: float, y: float, face: tuple[float, float], z: float = 1.1) -> None:
    """A control cabinet on a wall: screen, lamps, switches and conduits."""
    yaw = math.atan2(-face[0], face[1])
    g = p.part()
    g.box((-0.45, 0, z), (0.45, 0.22, z + 0.95), p.rng.choice(("grey", "teal", "dark")))
    g.box((-0.38, 0.2, z + 0.40), (0.16, 0.235, z + 0.85), p.rng.choice(("screen_a", "screen_b", "screen_c")))
    for i in range(4):
        mat = p.rng.choice(("lamp_red", "lamp_green", "lamp_warm", "dark"))
        g.rod((0.29, 0.22, z + 0.46 + 0.11 * i), (0.29, 0.25, z + 0.46 + 0.11 * i), 0.035, mat, 10)
    for i in range(6):
        g.box(
            (-0.36 + 0.12 * i, 0.21, z + 0.12),
            (-0.29 + 0.12 * i, 0.25, z + 0.30),
            p.rng.choice(("red", "white")),
        )
    for dx in (-0.3, -0.1, 0.25):
        g.rod((dx, 0.08, z + 0.9), (dx, 0.08, 3.25), 0.025, "galvanised", 8)
    g.object("panel", (x, y, 0), yaw)


def shelf(p: Place, x: float, y: float, yaw: float) -> None:
    """A steel rack, 2.4 m long, with boxes, cans and reels on four boards."""
    g, rng = p.part(), p.rng
    for sx in (-1.2, 1.2):
        for sy in (-0.3, 0.3):
            g.box((sx - 0.03, sy - 0.03, 0), (sx + 0.03, sy + 0.03, 2.5), "blue")
    for sx in (-1.2, 1.2):
        g.rod((sx, -0.3, 0.2), (sx, 0.3, 1.2), 0.015, "blue", 6)
        g.rod((sx, 0.3, 1.3), (sx, -0.3, 2.3), 0.015, "blue", 6)
    for z in (0.15, 0.85, 1.55, 2.25):
        g.box((-1.22, -0.32, z - 0.05), (1.22, 0.32, z), "orange")
        at = -1.1
        while at < 0.9:
            w, h, d = rng.uniform(0.16, 0.46), rng.uniform(0.16, 0.48), rng.uniform(0.3, 0.5)
            kind = rng.random()
            mat = rng.choice(("wood", "grey", "teal", "red", "white", "green", "yellow", "plate", "dark"))
            if kind < 0.62:
                g.box((at, -d / 2, z), (at + w, d / 2, z + h), mat)
                if w > 0.26:
                    g.box((at + 0.05, -d / 2 - 0.004, z + h * 0.4), (at + 0.18, -d / 2, z + h * 0.7), "white")
            elif kind < 0.92:
                w = 0.24
                g.rod(
                    (at + 0.12, 0, z), (at + 0.12, 0, z + 0.3), 0.11, rng.choice(("steel", "copper", mat)), 14
                )
                g.rod((at + 0.12, 0, z + 0.3), (at + 0.12, 0, z + 0.34), 0.05, "dark", 8)
            at += w + rng.uniform(0.03, 0.2)
    g.object("shelf", (x, y, 0), yaw)


def clutter(p: Place, x0: float, x1: float, y0: float, y1: float, count: int) -> None:
    """Crates and barrels scattered in a rectangle, off the camera's path."""
    rng = p.rng
    for _ in range(count):
        x, y = rng.uniform(x0, x1), rng.uniform(y0, y1)
        if rng.random() < 0.5:
            size = rng.choice((0.6, 0.8, 1.0))
            if p.free(x, y, size * 0.72):
                yaw = rng.uniform(-0.4, 0.4)
                crate(p, x, y, size, yaw)
                if rng.random() < 0.5:
                    crate(p, x + rng.uniform(-0.1, 0.1), y, size * 0.7, yaw + rng.uniform(-0.5, 0.5), size)
        elif p.free(x, y, 0.34):
            barrel(p, x, y)


# --- lamps ----------------------------------------------------------------------------------------------


def cage_lamp(p: Place, at: tuple, way: tuple, watts: float, color=WARM, glass="lamp_warm", cone=150.0):
    """A bulb in a wire cage that points along `way`; a small spot lamp in front of it gives the light."""
    way = Vector(way).normalized()
    g = p.part()
    g.rod((0, 0, -0.08), (0, 0, 0.0), 0.10, "dark", 12)
    g.tube([(0, 0, 0.0), (0, 0, 0.12), (0, 0, 0.19)], [0.065, 0.065, 0.03], glass, 12)
    for i in range(4):
        t = math.pi * i / 4
        c, s = 0.095 * math.cos(t), 0.095 * math.sin(t)
        g.tube([(c, s, 0), (c, s, 0.17), (0, 0, 0.25), (-c, -s, 0.17), (-c, -s, 0)], 0.008, "steel", 5)
    ob = g.object("cage_lamp")
    ob.matrix_world = Matrix.Translation(Vector(at)) @ way.to_track_quat("Z", "Y").to_matrix().to_4x4()
    spot = Vector(at) + way * 0.28
    return co.lamp(spot, color, watts, 0.0, cone, spot + way)


def tube_lamp(p: Place, x: float, y: float, z: float, along: int, watts: float, length: float = 1.3) -> None:
    """A fluorescent fitting; two narrow spots below it light the place."""
    size = [0.12, 0.12]
    size[along] = length
    g = p.part().block((x, y, z - 0.03), (size[0] + 0.1, size[1] + 0.06, 0.06), "white")
    size = [0.06, 0.06]
    size[along] = length - 0.1
    g.block((x, y, z - 0.09), (*size, 0.06), "lamp_cold")
    g.object("tube_lamp")
    ob = co.lamp((x, y, z - 0.14), COLD, watts, 0.0, 118.0, (x, y, z - 1))
    ob.data.spot_blend = 0.35


def flicker_lamp(p: Place, at: tuple, target: tuple, watts: float, colors: list[tuple]) -> None:
    """The lamp whose colour is drawn anew on every frame; the bulb's glass changes with it."""
    way = Vector(target) - Vector(at)
    ob = cage_lamp(p, at, way, watts, glass="flicker", cone=84.0)
    co.key_values(ob.data, "color", colors)
    tree = p.mats["flicker"].node_tree
    name = co.principled(p.mats["flicker"]).name
    if tree.animation_data is None:
        path = f'nodes["{name}"].inputs["Emission Color"].default_value'
        co.key_values(tree, path, [(*color, 1.0) for color in colors])
    for owner in (ob.data, tree):
        action = owner.animation_data.action
        for curve in action.layers[0].strips[0].channelbag(owner.animation_data.action_slot).fcurves:
            for point in curve.keyframe_points:
                point.interpolation = "CONSTANT"
