"""The bunker: concrete corridors, a machine hall and a pump room, after the UE4 "Bunker" of the papers.

Every (seed, split, clip) places machines, crates, pipes and lamps anew on one floor plan and takes one shot
of it; training and test shots walk different halves of each place. One lamp changes its colour at random on
every frame (white, yellow, blue, red) and shines on pipes: history shows colours that the current frame does
not have.

    corridor  x -1.9..1.9, y -24..0, with a side corridor west at its south end (the L-turn)
    hall      x -8..8,     y 0..26,  6.5 m high: columns, crane, fan, robot arm, gallery, store
    pumps     x -22..-8,   y 6..18,  5 m high: tanks, pumps with flywheels, pistons, manifolds
"""

import math
import random
import sys
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common as co
from bunker_kit import Part, bend, library, sign, spin

SETTINGS = {
    "test_samples": 64,
    "train_samples": 16,
    "denoise": True,
    "max_bounces": 1,
    "diffuse_bounces": 0,
    "glossy_bounces": 1,
    "exposure": 1.35,
}

FLICKER = ((1.0, 0.96, 0.90), (1.0, 0.72, 0.10), (0.12, 0.28, 1.0), (1.0, 0.07, 0.04))
SHOTS = ("corridor", "pumps", "hall", "turn", "gallery", "store")
WARM, COLD = (1.0, 0.80, 0.55), (0.78, 0.90, 1.0)


@dataclass
class Walk:
    """A hand-held walk: start, heading and turns in degrees (0 looks along +y, positive turns left)."""

    start: tuple[float, float, float]
    heading: float
    speed: float
    turn: float = 0.0
    look: float = 0.0
    look_rate: float = 0.0
    pitch: float = -3.0
    phase: float = 0.0

    def matrix(self, frame: int) -> Matrix:
        """Camera matrix at a frame."""
        x, y, z = self.start
        for step in range(frame):
            angle = math.radians(self.heading + self.turn * step)
            x, y = x - math.sin(angle) * self.speed, y + math.cos(angle) * self.speed
        z += 0.018 * math.sin(0.55 * frame + self.phase)
        view = math.radians(self.heading + self.turn * frame + self.look + self.look_rate * frame)
        view += math.radians(0.25) * math.sin(0.8 * frame + 2 * self.phase)
        pitch = math.radians(self.pitch + 0.5 * math.sin(0.42 * frame + self.phase))
        target = (x - math.sin(view), y + math.cos(view), z + math.tan(pitch))
        return co.look_at((x, y, z), target, roll=math.radians(0.5) * math.sin(0.37 * frame + self.phase))


def shot(kind: str, split: str, rng: random.Random) -> Walk:
    """The walk of a shot; training and test take different halves of the place and other directions."""
    test = split == "test"
    jitter, phase = rng.uniform(-1, 1), rng.uniform(0, math.tau)
    side = rng.choice((-1, 1))
    if kind == "corridor":
        y = rng.uniform(-11.5, -9.5) if test else rng.uniform(-19.5, -14.0)
        speed = rng.uniform(0.07, 0.10)
        start, heading, look = (0.45 * jitter, y, 1.62), 2 * jitter, 9 * side
        return Walk(start, heading, speed, look=look, look_rate=-0.75 * side, pitch=-4, phase=phase)
    if kind == "pumps":
        speed = rng.uniform(0.06, 0.08)
        if test:
            start = (-17.8 + jitter, 9.1, 1.6)
            return Walk(start, -92, speed, look=58, look_rate=0.45, pitch=-1, phase=phase)
        start, look = (-11.5 + 1.2 * jitter, 9.4, 1.6), -52 - 6 * jitter
        return Walk(start, 90, speed, look=look, look_rate=0.5 * side, pitch=-1, phase=phase)
    if kind == "hall":
        if test:
            start, speed = (1.6 + 0.5 * jitter, 23.0, 1.7), rng.uniform(0.08, 0.11)
            return Walk(start, 172, speed, -0.3, look=14, look_rate=0.4 * side, pitch=3, phase=phase)
        start, speed = (0.6 + 0.5 * jitter, rng.uniform(1.5, 3.5), 1.7), rng.uniform(0.08, 0.11)
        return Walk(start, 0, speed, look=10 * side, look_rate=-0.6 * side, pitch=3, phase=phase)
    if kind == "turn":
        if test:
            start, look = (-8.0 + jitter, -22.1, 1.6), 6 * side
            return Walk(start, -90, 0.09, look=look, look_rate=-0.7 * side, pitch=-3, phase=phase)
        start = (-2.3 + 0.2 * jitter, -22.4, 1.6)
        return Walk(start, -70, 0.09, 1.1, look=32, look_rate=0.75, pitch=-4, phase=phase)
    if kind == "gallery":
        if test:
            start = (5.9, 21.5 + jitter, 4.9)
            return Walk(start, 180, 0.07, look=-46, look_rate=-0.5, pitch=-17, phase=phase)
        start, look = (5.9, 4.5 + jitter, 4.9), 44 + 5 * jitter
        return Walk(start, 0, 0.07, look=look, look_rate=0.5, pitch=-17, phase=phase)
    rate = 0.55 * side
    if test:
        return Walk((1.5, 15.5 + jitter, 1.6), 10, 0.075, look=-62, look_rate=rate, pitch=-2, phase=phase)
    return Walk((1.2, 5.0 + jitter, 1.6), 0, 0.075, look=-58, look_rate=rate, pitch=-2, phase=phase)


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


# --- shell ----------------------------------------------------------------------------------------------


def wall(
    part: Part, a: tuple, b: tuple, height: float, mat: str, openings: list[tuple] = (), base=0.0
) -> None:
    """A wall 0.3 m thick along x or y from `a` to `b`; openings are (from, to, sill, head) along it."""
    along = 0 if a[1] == b[1] else 1
    start, end = min(a[along], b[along]), max(a[along], b[along])

    def slab(s: float, e: float, low: float, high: float) -> None:
        if e - s < 1e-3 or high - low < 1e-3:
            return
        if along == 0:
            part.box((s, a[1] - 0.15, low), (e, a[1] + 0.15, high), mat)
        else:
            part.box((a[0] - 0.15, s, low), (a[0] + 0.15, e, high), mat)

    at = start
    for left, right, sill, head in sorted(openings):
        slab(at, left, base, height)
        slab(left, right, base, sill)
        slab(left, right, head, height)
        at = right
    slab(at, end, base, height)


def frame_of(part: Part, x: float, y: float, along: int, width: float, head: float, mat: str) -> None:
    """Steel frame around an opening centred at (x, y) in a wall along axis `along`."""
    d = [0.0, 0.0]
    d[along] = width / 2 + 0.08
    size = [0.46, 0.46]
    size[along] = 0.18
    for s in (-1, 1):
        part.block((x + s * d[0], y + s * d[1], head / 2), (*size, head), mat)
    size[along] = width + 0.34
    part.block((x, y, head + 0.12), (*size, 0.24), mat)


def shell(p: Place) -> None:
    """Walls, floors and ceilings of all places."""
    s = p.part()
    # Corridor and the side corridor at its south end.
    wall(s, (-2.05, -20.2), (-2.05, 0), 3.3, "wall")
    wall(s, (2.05, -24.2), (2.05, 0), 3.3, "wall")
    wall(s, (-16, -24.15), (2.2, -24.15), 3.3, "wall")
    wall(s, (-16, -20.35), (-1.9, -20.35), 3.3, "wall")
    wall(s, (-16.15, -24.3), (-16.15, -20.2), 3.3, "wall")
    s.box((-2.2, -24.3, 3.3), (2.2, 0.15, 3.6), "ceiling")
    s.box((-16.3, -24.3, 3.3), (-2.2, -20.2, 3.6), "ceiling")
    # Floor of the corridor with a trench in its middle; a grating covers it.
    s.box((-2.2, -20.0, -0.6), (-0.6, 0.15, 0), "floor")
    s.box((0.6, -20.0, -0.6), (2.2, 0.15, 0), "floor")
    s.box((-0.6, -20.0, -0.8), (0.6, 0.15, -0.5), "pit")
    s.box((-16.3, -24.3, -0.6), (2.2, -20.0, 0), "floor")
    # Hall.
    wall(s, (-8.15, 0), (-8.15, 26.3), 6.5, "hallwall", [(9.0, 15.0, 0.0, 4.0)])
    wall(s, (8.15, 0), (8.15, 26.3), 6.5, "hallwall")
    wall(s, (-8.3, 0.15), (8.3, 0.15), 6.5, "hallwall", [(-1.5, 1.5, 0.0, 2.8)])
    wall(s, (-8.3, 26.15), (8.3, 26.15), 6.5, "hallwall", [(-1.5, 1.5, 3.1, 6.1)])
    s.box((-8.3, 0.0, -0.3), (8.3, 26.3, 0), "floor")
    s.box((-8.3, 0.0, 6.5), (8.3, 26.3, 6.8), "ceiling")
    for y in (4, 8, 12, 16, 20, 24):
        s.box((-8, y - 0.2, 6.0), (8, y + 0.2, 6.5), "column")
    frame_of(s, 0, 0.15, 0, 3.0, 2.8, "stripes")
    frame_of(s, -8.15, 12, 1, 6.0, 4.0, "stripes")
    # Pump room.
    wall(s, (-22.15, 6), (-22.15, 18), 5, "wall")
    wall(s, (-22.3, 5.85), (-8, 5.85), 5, "wall")
    wall(s, (-22.3, 18.15), (-8, 18.15), 5, "wall")
    s.box((-22.3, 5.7, -0.3), (-8.3, 18.3, 0), "floor")
    s.box((-22.3, 5.7, 5), (-8.3, 18.3, 5.3), "ceiling")
    s.object("shell")
    lines = p.part()
    for x in (-2.3, 2.9):
        lines.box((x, 0.8, 0.0), (x + 0.12, 25.5, 0.006), "yellow_line")
    for x in (-1.45, 1.33):
        lines.box((x, -20, 0.0), (x + 0.12, -0.2, 0.006), "yellow_line")
    for y in (8.3, 15.6):
        lines.box((-21.5, y, 0.0), (-8.6, y + 0.12, 0.006), "yellow_line")
    lines.box((-8.6, 9.1, 0.0), (-8.3, 14.9, 0.006), "stripes")
    lines.box((-1.5, 0.3, 0.0), (1.5, 0.7, 0.006), "stripes")
    lines.object("lines")


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


# --- machines -------------------------------------------------------------------------------------------


def fan(p: Place, at: tuple, axis: str, radius: float, rate: float) -> None:
    """A ventilator: ring, guard and turning blades; a lamp behind it throws the blades' shadows."""
    base = Matrix.Translation(Vector(at)) @ (
        Matrix.Rotation(math.pi / 2, 4, "X") if axis == "Y" else Matrix.Rotation(math.pi / 2, 4, "Y")
    )
    rotor = p.part()
    for i in range(5):
        turn = Matrix.Rotation(math.tau * i / 5, 4, "Z") @ Matrix.Rotation(0.5, 4, "X")
        rotor.box((0.12, -0.20 * radius, -0.012), (radius * 0.94, 0.20 * radius, 0.012), "steel", turn)
    rotor.rod((0, 0, -0.16), (0, 0, 0.16), 0.17, "red", 16)
    spin(rotor.object("fan_rotor"), p.frames, base, "Z", lambda f: rate * f)
    guard = p.part()
    for r in (radius, radius * 0.66, radius * 0.33):
        guard.ring((0, 0, -0.26), "Z", r, 0.016, "yellow", 32, 6)
    for i in range(4):
        turn = math.tau * i / 8
        c, s = radius * math.cos(turn), radius * math.sin(turn)
        guard.rod((-c, -s, -0.26), (c, s, -0.26), 0.014, "yellow", 6)
    guard.ring((0, 0, 0), "Z", radius * 1.06, 0.09, "dark", 32, 8)
    guard.object("fan_guard").matrix_world = base


def crane(p: Place, y0: float, speed: float, x0: float, drift: float) -> None:
    """An overhead crane: rails, a moving girder, a trolley and a swinging hook with a load."""
    rails = p.part()
    for x in (-7.5, 7.5):
        rails.box((x - 0.12, 0.4, 5.1), (x + 0.12, 25.9, 5.4), "yellow")
        for y in range(1, 26, 4):
            rails.box((x - 0.1, y - 0.1, 4.7), (x + 0.1, y + 0.1, 5.1), "dark")
            wall_x = math.copysign(8, x)
            rails.box((min(x, wall_x), y - 0.08, 4.9), (max(x, wall_x), y + 0.08, 5.1), "dark")
    rails.object("crane_rails")
    girder = p.part()
    for dy in (-0.55, 0.55):
        girder.box((-7.6, dy - 0.09, 5.42), (7.6, dy + 0.09, 5.86), "yellow")
    for x in (-7.5, 7.5):
        girder.box((x - 0.2, -0.9, 5.4), (x + 0.2, 0.9, 5.62), "dark")
    girder.box((-1.2, -0.645, 5.50), (1.2, -0.64, 5.80), "stripes")
    ob = girder.object("girder")
    co.key_motion(ob, p.frames, lambda f: co.place((0, y0 + speed * f, 0)))
    trolley = p.part()
    trolley.box((-0.5, -0.65, 5.86), (0.5, 0.65, 6.0), "dark")
    trolley.rod((-0.4, 0, 5.7), (0.4, 0, 5.7), 0.2, "red", 14)
    cart = trolley.object("trolley")
    co.key_motion(cart, p.frames, lambda f: co.place((x0 + drift * f, y0 + speed * f, 0)))
    hook = p.part()  # origin at the drum; it swings about it
    length = p.rng.uniform(2.0, 2.7)
    for dx in (-0.06, 0.06):
        hook.rod((dx, 0, 0), (dx, 0, -length), 0.014, "steel", 6)
    hook.box((-0.12, -0.08, -length - 0.3), (0.12, 0.08, -length), "stripes")
    curl = [
        (0.11 * math.sin(t), 0, -length - 0.42 - 0.11 * math.cos(t))
        for t in (i * 0.35 - 2.4 for i in range(14))
    ]
    hook.tube([(0, 0, -length - 0.3), *curl], 0.03, "steel", 8)
    for dx in (-0.5, 0.5):
        hook.rod((0, 0, -length - 0.5), (dx, 0, -length - 1.0), 0.012, "rubber", 6)
    hook.rod((-0.75, 0, -length - 1.12), (0.75, 0, -length - 1.12), 0.16, "galvanised", 16)
    phase = p.rng.uniform(0, 6)
    co.key_motion(
        hook.object("hook"),
        p.frames,
        lambda f: co.place(
            (x0 + drift * f, y0 + speed * f, 5.6),
            (0.05 * math.sin(0.3 * f + phase), 0.06 * math.sin(0.25 * f), 0.03 * f),
        ),
    )


def robot(p: Place, x: float, y: float) -> None:
    """A robot arm on a plinth: four links, each keyed relative to its parent."""
    rng, frames = p.rng, p.frames
    base = p.part()
    base.rod((0, 0, 0), (0, 0, 0.35), 0.5, "dark", 20).rod((0, 0, 0.35), (0, 0, 0.42), 0.46, "stripes", 20)
    base.object("robot_base", (x, y, 0))
    waist = (
        p.part()
        .rod((0, 0, 0), (0, 0, 0.5), 0.32, "orange", 18)
        .rod((-0.3, 0, 0.6), (0.3, 0, 0.6), 0.2, "dark", 16)
    )
    waist = waist.object("robot_waist")
    upper = p.part().box((-0.14, -0.12, -0.1), (0.14, 0.12, 1.35), "orange")
    upper.rod((-0.26, 0, 1.3), (0.26, 0, 1.3), 0.17, "dark", 16)
    upper.rod((0.2, 0.05, 0.1), (0.2, 0.05, 1.2), 0.035, "chrome", 8)
    upper = upper.object("robot_upper", parent=waist)
    fore = (
        p.part()
        .box((-0.1, -0.1, 0), (0.1, 0.1, 0.95), "orange")
        .rod((0, 0, 0.9), (0, 0, 1.15), 0.09, "steel", 12)
    )
    fore.tube([(0.14, 0, 0.0), (0.2, 0, 0.4), (0.12, 0, 0.95)], 0.03, "rubber", 6)
    fore = fore.object("robot_fore", parent=upper)
    hand = p.part().box((-0.16, -0.05, 0), (0.16, 0.05, 0.08), "dark")
    for s in (-1, 1):
        hand.box((s * 0.13 - 0.02, -0.03, 0.08), (s * 0.13 + 0.02, 0.03, 0.3), "chrome")
    hand.box((-0.11, -0.11, 0.16), (0.11, 0.11, 0.38), "red")
    hand = hand.object("robot_hand", parent=fore)
    a, b = rng.uniform(0, 6), rng.uniform(0, 6)
    wave = lambda rate, f, phase: math.sin(rate * f + phase)  # noqa: E731
    co.key_motion(waist, frames, lambda f: co.place((x, y, 0.42), (0, 0, a + 0.06 * f)))
    co.key_motion(upper, frames, lambda f: co.place((0, 0, 0.6), (0.3 + 0.35 * wave(0.16, f, a), 0, 0)))
    co.key_motion(fore, frames, lambda f: co.place((0, 0, 1.3), (1.1 + 0.5 * wave(0.2, f, b), 0, 0)))
    co.key_motion(hand, frames, lambda f: co.place((0, 0, 1.15), (0.4 * wave(0.25, f, a), 0, 0.12 * f)))


def pump(p: Place, x: float, y: float, rate: float) -> None:
    """A piston pump: bed, cylinder, crank flywheel with spokes, rod and crosshead, keyed exactly."""
    bed = p.part()
    bed.box((-1.5, -0.45, 0), (1.3, 0.45, 0.3), "pit").box((-1.4, -0.35, 0.3), (1.2, 0.35, 0.42), "teal")
    bed.rod((0.35, 0, 0.85), (1.15, 0, 0.85), 0.26, "teal", 18)
    for at in (0.38, 1.1):
        bed.rod((at, 0, 0.85), (at + 0.08, 0, 0.85), 0.32, "steel", 18)
    bed.rod((0.75, 0, 1.05), (0.75, 0, 1.6), 0.09, "brass", 12).box(
        (0.5, -0.25, 0.42), (1.0, 0.25, 0.65), "dark"
    )
    bed.box((-0.98, -0.34, 0.42), (-0.82, -0.22, 0.92), "red").box(
        (-0.98, 0.22, 0.42), (-0.82, 0.34, 0.92), "red"
    )
    bed.rod((-0.9, -0.55, 0.85), (-0.9, 0.4, 0.85), 0.05, "chrome", 10)
    bed.object("pump_bed", (x, y, 0))
    wheel = p.part().ring((0, 0, 0), "Y", 0.60, 0.065, "red", 28, 8)
    for i in range(6):
        t = math.tau * i / 6
        wheel.rod((0, 0, 0), (0.58 * math.cos(t), 0, 0.58 * math.sin(t)), 0.032, "red", 6)
    wheel.rod((0, -0.07, 0), (0, 0.07, 0), 0.11, "dark", 14).rod(
        (0.26, 0, 0), (0.26, 0.36, 0), 0.04, "chrome", 8
    )
    phase, crank, link = p.rng.uniform(0, 6), 0.26, 0.95
    angle = lambda f: phase + rate * f  # noqa: E731
    hub = Vector((x - 0.9, y - 0.5, 0.85))
    co.key_motion(wheel.object("flywheel"), p.frames, lambda f: co.place(hub, (0, angle(f), 0)))

    def reach(f: int) -> float:
        return crank * math.cos(angle(f)) + math.sqrt(link**2 - (crank * math.sin(angle(f))) ** 2)

    rod = p.part().box((0, -0.03, -0.045), (link, 0.03, 0.045), "chrome")
    rod.rod((link, -0.08, 0), (link, 0.08, 0), 0.08, "steel", 12)
    tilt = lambda f: math.asin(-crank * math.sin(angle(f)) / link)  # noqa: E731
    co.key_motion(
        rod.object("connecting_rod"),
        p.frames,
        lambda f: co.place(
            hub + Vector((crank * math.cos(angle(f)), 0.2, -crank * math.sin(angle(f)))),
            (0, tilt(f), 0),
        ),
    )
    piston = p.part().rod((0, 0.0, 0), (0.75, 0.0, 0), 0.055, "chrome", 12)
    co.key_motion(piston.object("piston"), p.frames, lambda f: co.place(hub + Vector((reach(f), 0.3, 0))))


def gears(p: Place, at: tuple, rate: float) -> None:
    """Two meshing gears on a wall that faces +x."""
    for radius, teeth, dy, way, mat in ((0.62, 18, 0.0, 1, "brass"), (0.31, 9, 0.96, -2, "steel")):
        g = p.part().rod((-0.06, 0, 0), (0.06, 0, 0), radius, mat, 36)
        g.rod((0.06, 0, 0), (0.12, 0, 0), radius * 0.3, "dark", 16)
        for i in range(teeth):
            turn = Matrix.Rotation(math.tau * (i + (0.5 if way < 0 else 0)) / teeth, 4, "X")
            g.box((-0.055, -0.05, radius - 0.02), (0.055, 0.05, radius + 0.08), mat, turn)
        for i in range(5):
            t = math.tau * i / 5
            y, z = radius * 0.62 * math.cos(t), radius * 0.62 * math.sin(t)
            g.rod((0.055, y, z), (0.075, y, z), radius * 0.17, "dark", 12)
        base = Matrix.Translation(Vector(at) + Vector((0, dy, 0)))
        spin(g.object("gear"), p.frames, base, "X", lambda f, w=way: w * rate * f)


def tank(p: Place, x: float, y: float, radius: float, height: float, mat: str) -> None:
    """A vertical vessel on legs with a dome, hoops, a gauge and a ladder."""
    g = p.part()
    steps = [(0.35, 0.5), (0.75, 0.58), (0.95, 0.70), (1.0, 0.85), (1.0, height - 0.3), (0.95, height - 0.15),
             (0.75, height - 0.04), (0.35, height + 0.03), (0.05, height + 0.05)]  # fmt: skip
    g.tube([(0, 0, z) for _, z in steps], [r * radius for r, _ in steps], mat, 28)
    for z in (1.0, height * 0.5, height - 0.45):
        g.rod((0, 0, z - 0.03), (0, 0, z + 0.03), radius + 0.025, "steel", 28)
    g.rod((0, 0, height * 0.62), (0, 0, height * 0.62 + 0.22), radius + 0.008, "stripes", 28)
    for i in range(4):
        t = math.tau * (i + 0.5) / 4
        g.block((0.8 * radius * math.cos(t), 0.8 * radius * math.sin(t), 0.42), (0.12, 0.12, 0.84), "dark")
    for s in (-0.18, 0.18):
        g.rod((s, -radius - 0.12, 0.2), (s, -radius - 0.12, height), 0.018, "yellow", 6)
    for i in range(int(height / 0.3)):
        g.rod(
            (-0.18, -radius - 0.12, 0.3 + 0.3 * i), (0.18, -radius - 0.12, 0.3 + 0.3 * i), 0.014, "yellow", 6
        )
    g.object("tank", (x, y, 0), p.rng.uniform(-0.6, 0.6))


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


# --- places ---------------------------------------------------------------------------------------------


def corridor(p: Place, colors: list[tuple], lit: bool) -> None:
    rng = p.rng
    grating(p, -0.58, 0.58, -20.0, 0.0, 0.0, "grating")
    for x, r, mat in ((-0.3, 0.11, "rusty"), (0.05, 0.08, "copper"), (0.33, 0.10, "teal")):
        pipe(p, [(x, -20, -0.36), (x, 0, -0.36)], r, mat, 3.0)
    side = rng.choice((-1, 1))
    pipe_rack(p, 1.9 * side, -19.2, -0.6, 2.75, -side)
    duct = p.part()
    duct.box((-side * 1.85, -19.8, 2.72), (-side * 1.15, -0.1, 3.22), "galvanised")
    for y in range(-19, 0, 3):
        duct.box((-side * 1.88, y - 0.05, 2.69), (-side * 1.12, y + 0.05, 3.25), "dark")
    duct.object("duct")
    tray(p, side * 0.85, -19.8, -0.1, 2.95)
    cables(p, (-side * 1.84, -19.8, 2.45), (-side * 1.84, -0.3, 2.45), 4)
    y, number = -18.5 + rng.uniform(0, 1), rng.randint(2, 6)
    while y < -1.5:
        kind = rng.choice(("door", "panel", "sign", "crates"))
        face = (side, 0)
        if kind == "door":
            door(p, -side * 1.9, y, face, rng.choice(("teal", "red", "grey", "blue")), f"B-{number}")
        elif kind == "panel":
            panel(p, -side * 1.9, y, face)
        elif kind == "sign":
            text = rng.choice((f"SECTOR {number:02d}", "DANGER", "EXIT >", "LEVEL -3", "NO ENTRY"))
            sign(text, 0.42, p.mats[rng.choice(("dark", "yellow", "red"))], (-side * 1.885, y, 1.75),
                 (math.pi / 2, 0, math.pi / 2 * side))  # fmt: skip
        for dy in (-0.7, 0.9):
            if kind in ("crates", "sign") and p.free(-side * 1.45, y + dy, 0.32, 0.55):
                barrel(p, -side * 1.45, y + dy) if rng.random() < 0.6 else crate(
                    p, -side * 1.45, y + dy, 0.6, 0
                )
        number += 1
        y += rng.uniform(1.7, 2.5)
    rib = p.part()
    for y in range(-18, 0, 6):
        for x in (-1.9, 1.72):
            rib.box((x, y - 0.16, 0), (x + 0.18, y + 0.16, 3.3), "column")
        rib.box((-1.9, y - 0.16, 3.12), (1.9, y + 0.16, 3.3), "column")
    rib.object("ribs")
    # The side corridor.
    pipe_rack(p, -3.0, -24.0, -24.0, 0.0, 1)
    west = rng.choice(("teal", "red"))
    for z, r, mat in ((2.5, 0.13, west), (2.15, 0.08, "steel"), (1.88, 0.06, "copper")):
        pipe(p, [(-16, -23.8, z), (1.5, -23.8, z), (1.5, -23.8, 3.2)], r, mat)
    for x in (-12.5, -9.0, -5.5, -2.5):
        valve(p, (x + rng.uniform(-0.5, 0.5), -23.8, 2.15), "Y", 0.08, rng.choice(("red", "yellow")))
    for x in (-14.0, -10.8, -7.6, -4.4):
        kind, at = rng.choice(("door", "panel")), x + rng.uniform(-0.5, 0.5)
        door(p, at, -20.5, (0, -1), "grey", "C-1") if kind == "door" else panel(p, at, -20.5, (0, -1))
    clutter(p, -15.4, -3.0, -23.5, -23.2, 12)
    clutter(p, -15.4, -3.0, -21.1, -20.9, 5)
    sign("EXIT >", 0.5, p.mats["yellow"], (0.2, -23.99, 1.3), (math.pi / 2, 0, math.pi))
    fan(p, (-15.75, -22.2, 1.7), "X", 0.95, rng.choice((-1, 1)) * rng.uniform(0.10, 0.16))
    if not lit:
        return
    for y in (-19.0, -13.4, -7.8, -2.2):
        tube_lamp(p, -side * 0.3, y + rng.uniform(-0.4, 0.4), 3.28, 1, rng.uniform(205, 280))
    for x in (-13.0, -7.4):
        tube_lamp(p, x, -22.2, 3.28, 0, rng.uniform(150, 205))
    near = p.path[0]
    ahead = near.y + rng.uniform(3.2, 4.2) if near.y > -20 else -17.5
    flicker_lamp(
        p, (-side * 0.9, min(ahead, -1.0), 2.55), (side * 1.9, min(ahead, -1.0) + 0.3, 1.5), 120, colors
    )


def hall(p: Place, colors: list[tuple], lit: str) -> None:
    rng = p.rng
    columns = p.part()
    for x in (-4.9, 4.3):
        for y in (4, 10, 16, 22):
            columns.box((x - 0.3, y - 0.3, 0), (x + 0.3, y + 0.3, 6.5), "column")
            columns.box((x - 0.32, y - 0.32, 0.0), (x + 0.32, y + 0.32, 1.15), "stripes")
            columns.box((x - 0.45, y - 0.45, 5.9), (x + 0.45, y + 0.45, 6.1), "dark")
            p.taken.append((x, y, 0.5))
    columns.object("columns")
    for i, y in enumerate((4, 10, 16, 22)):
        for x, way in ((-4.9, 1), (4.3, -1)):
            text, dark = f"{'A' if x < 0 else 'B'}{i + 1}", p.mats["dark"]
            sign(text, 0.5, dark, (x + way * 0.31, y, 1.75), (math.pi / 2, 0, way * math.pi / 2))
            sign(text, 0.5, dark, (x, y - 0.31, 1.75), (math.pi / 2, 0, 0))
    start, ahead = p.path[0], 1 if p.path[-1].y >= p.path[0].y else -1
    crane_y = start.y + rng.uniform(3, 6) * ahead if start.x > -8 else 12
    speed = rng.choice((-1, 1)) * rng.uniform(0.03, 0.06)
    crane(p, crane_y, speed, rng.uniform(-2.5, 0.5), rng.uniform(-0.04, 0.04))
    for x, y in ((-2.9, 7.2), (-3.0, 18.6)):
        if p.free(x, y, 1.0, 0.9):
            robot(p, x, y)
    # Gallery along the east wall, at 3.3 m, with a railing.
    grating(p, 5.4, 7.9, 0.4, 25.9, 3.3, "gallery", 0.17)
    rail = p.part()
    rail.box((5.32, 0.4, 3.02), (5.42, 25.9, 3.32), "yellow")
    for y in range(1, 26, 2):
        rail.rod((5.38, y, 3.3), (5.38, y, 4.3), 0.025, "yellow", 8)
        if y % 4 == 1:
            rail.rod((5.38, y, 0), (5.38, y, 3.05), 0.07, "dark", 10)
    for z in (3.65, 3.98, 4.3):
        rail.rod((5.38, 0.5, z), (5.38, 25.8, z), 0.025, "yellow", 8)
    rail.object("railing")
    # West wall: pipes. East wall: shelves and cabinets. Ducts and a big pipe overhead.
    pipe_rack(p, -8.0, 0.6, 8.4, 3.0, 1)
    pipe_rack(p, -8.0, 15.8, 25.6, 3.0, 1)
    for x, z, r, mat in ((-6.6, 4.5, 0.24, "teal"), (-5.9, 4.6, 0.14, "copper"), (3.2, 5.6, 0.18, "red")):
        pipe(p, [(x, 0.3, z), (x, 25.9, z)], r, mat, 3.0)
    pipe(p, [(-6.6, 3, 4.5), (-6.6, 3, 0.4), (-7.8, 3, 0.4)], 0.2, "teal", 1.6)
    pipe(p, [(-5.9, 20, 4.6), (-5.9, 20, 0.3), (-7.8, 20, 0.3)], 0.13, "copper", 1.4)
    valve(p, (-6.6, 3, 1.3), "-Y", 0.2, "red", 0.05)
    valve(p, (-5.9, 20, 1.3), "X", 0.13, "red", 0.05)
    duct = p.part()
    duct.box((-3.6, 0.3, 5.3), (-2.7, 26, 5.95), "galvanised")
    for y in range(2, 26, 3):
        duct.box((-3.64, y - 0.06, 5.26), (-2.66, y + 0.06, 5.99), "dark")
    if p.path[0].z < 3:
        duct.object("duct")
    y = 1.6
    while y < 25:
        kind = rng.random()
        if kind < 0.62:
            shelf(p, 7.55, y + 0.6, math.pi / 2)
            p.taken.append((7.4, y + 0.6, 1.25))
        elif kind < 0.85:
            panel(p, 8.0, y + 0.4, (-1, 0))
        else:
            door(p, 8.0, y + 0.4, (-1, 0), rng.choice(("teal", "red", "blue")), f"D-{int(y)}")
        y += rng.uniform(2.6, 3.2)
    gears(p, (-7.8, rng.choice((6.4, 18.0)), 3.9), 0.05)
    clutter(p, -7.0, -3.2, 1.0, 8.0, 14)
    clutter(p, -7.0, -3.2, 16.0, 25.0, 16)
    clutter(p, 3.4, 7.0, 0.8, 25.0, 30)
    clutter(p, -1.6, 2.4, 1.0, 25.0, 10)
    fan(p, (0, 26.1, 4.6), "Y", 1.35, rng.choice((-1, 1)) * rng.uniform(0.08, 0.13))
    for text, x, z in (("HALL 3", 4.6, 4.6), ("MAX 12 T", -4.6, 5.0)):
        sign(text, 0.8, p.mats["red"], (x, 25.98, z), (math.pi / 2, 0, 0))
        sign(text, 0.8, p.mats["yellow"], (x, 0.32, z), (math.pi / 2, 0, math.pi))
    if not lit:
        return
    if lit == "door":  # seen through the corridor's end only
        cage_lamp(p, (0, 6.0, 6.0), (0, 0, -1), 700, cone=90)
        return
    back = co.lamp((0.5, 29.0, 8.5), (1.0, 0.86, 0.62), 5200, 0.0, 60.0, (0, 20.0, 0.5))
    back.data.spot_blend = 0.2
    for x, y in ((-1.0, 3.2), (0.8, 9.4), (-1.0, 15.6), (0.8, 21.8)):
        cage_lamp(p, (x, y, 6.0), (0, 0, -1), rng.uniform(950, 1200), cone=96)
    near = p.path[len(p.path) // 2]
    y = min(max(near.y + (4 if p.path[-1].y > p.path[0].y else -4), 2), 24)
    y = y if not 7.5 < y < 16.5 else (6.2 if y < 12 else 17.5)
    flicker_lamp(p, (-5.6, y, 3.3), (-8.0, y + 0.5, 1.3), 170, colors)


def pumps(p: Place, colors: list[tuple], lit: bool) -> None:
    rng = p.rng
    mats = ["teal", "white", "steel", "rusty"]
    rng.shuffle(mats)
    for i, x in enumerate((-20.2, -16.8, -13.4, -10.2)):
        x += rng.uniform(-0.3, 0.3)
        tank(p, x, 16.6, rng.uniform(0.85, 1.1), rng.uniform(3.0, 3.9), mats[i])
        side = x + 1.35
        riser = [(side, 17.9, 0.5), (side, 17.3, 0.5), (side, 17.3, 4.4), (side, 17.9, 4.4)]
        pipe(p, riser, 0.11, rng.choice(("copper", "red", "yellow")), 1.5)
        valve(p, (side, 17.3, 1.5), "-Y", 0.11, rng.choice(("red", "yellow")), 0.06)
        pipe(p, [(x, 16.6, 3.8), (x, 16.6, 4.55), (x, 14.0, 4.55)], 0.12, "steel", 1.6)
    pipe(p, [(-22, 14.0, 4.55), (-8.4, 14.0, 4.55)], 0.2, "teal", 2.6)
    pipe(p, [(-22, 13.4, 4.6), (-8.4, 13.4, 4.6)], 0.11, "red", 2.2)
    pipe(p, [(-22, 12.9, 4.65), (-8.4, 12.9, 4.65)], 0.07, "copper", 2.2)
    for x in (-20.0, -16.6, -13.2, -10.4):
        pump(p, x + rng.uniform(-0.2, 0.2), 13.5, rng.uniform(0.09, 0.17) * rng.choice((-1, 1)))
        p.taken.append((x, 13.6, 1.5))
        pipe(p, [(x + 0.75, 13.5, 1.6), (x + 0.75, 13.5, 4.5)], 0.085, rng.choice(("yellow", "copper")), 1.4)
        valve(p, (x + 0.75, 13.5, 2.1), "-Y", 0.09, "red", 0.05)
    for z, r, mat in ((0.5, 0.16, "teal"), (0.95, 0.08, "steel"), (1.3, 0.10, "red"), (2.6, 0.12, "rusty")):
        pipe(p, [(-22, 6.3, z), (-8.4, 6.3, z)], r, mat, 2.4)
        for x in (-20, -17, -13.5, -10.5):
            if r > 0.09:
                valve(p, (x + rng.uniform(-0.8, 0.8), 6.3, z), "Y", r, rng.choice(("red", "yellow", "blue")))
    for x in (-19, -14.5, -11):
        panel(p, x, 6.0, (0, 1), 1.5)
    gears(p, (-21.8, 10.6, 2.2), rng.uniform(0.04, 0.07))
    door(p, -22, 8.2, (1, 0), "red", "P-1")
    clutter(p, -21.4, -8.8, 7.3, 8.0, 8)
    clutter(p, -21.6, -9.0, 11.6, 12.2, 8)
    sign("PUMPS", 0.7, p.mats["yellow"], (-15.2, 17.99, 4.25), (math.pi / 2, 0, 0))
    if not lit:
        return
    for x in (-19.6, -15.4, -11.2):
        cage_lamp(p, (x, 11.2, 4.95), (0, 0.1, -1), rng.uniform(380, 480), cone=100)
    near = p.path[len(p.path) // 2]
    flicker_lamp(p, (near.x + rng.uniform(-1.5, 1.5), 12.3, 4.2), (near.x, 17.2, 1.6), 420, colors)


def build(*, seed: int, split: str, clip: int, frames: int) -> None:
    """Build the bunker of one clip into an emptied file; frames 0..frames+1 are keyed."""
    rng = co.generator("bunker", seed, split, clip)
    kind = SHOTS[clip % len(SHOTS)]
    walk = shot(kind, split, rng)
    camera = co.camera(fov_deg=74.0, near=0.05, far=120.0)
    camera.name = f"camera_{kind}"
    matrices = [walk.matrix(frame) for frame in range(frames + 2)]
    co.key_matrices(camera, matrices)
    co.sky([(-1.0, (0.01, 0.01, 0.012)), (1.0, (0.02, 0.02, 0.024))], 1.0)

    previous, colors = -1, []
    for _ in range(frames + 2):
        choice = rng.choice([i for i in range(len(FLICKER)) if i != previous])
        colors.append(FLICKER[choice])
        previous = choice
    place = Place(library(), rng, [matrix.translation for matrix in matrices], frames)
    shell(place)
    corridor(place, colors, lit=kind in ("corridor", "turn"))
    hall(
        place, colors, lit={"corridor": "door", "hall": "all", "gallery": "all", "store": "all"}.get(kind, "")
    )
    pumps(place, colors, lit=kind == "pumps")
    bpy.context.view_layer.update()
