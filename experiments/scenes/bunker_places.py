"""The bunker's rooms: the shell, and what stands, hangs and shines in corridor, hall and pump room.

Floor plan: see bunker.py. Positions are world metres; what is random is drawn from the `Place`'s generator.
"""

import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common as co
from bunker_kit import Part, sign
from bunker_machines import crane, fan, gears, pump, robot, tank
from bunker_parts import (
    Place,
    barrel,
    cables,
    cage_lamp,
    clutter,
    crate,
    door,
    flicker_lamp,
    grating,
    panel,
    pipe,
    pipe_rack,
    shelf,
    tray,
    tube_lamp,
    valve,
)


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
    last = ""
    while y < -1.5:
        kind = rng.choice(("door", "panel", "sign", "crates"))
        face = (side, 0)
        if kind == "door":
            door(p, -side * 1.9, y, face, rng.choice(("teal", "red", "grey", "blue")), f"B-{number}")
        elif kind == "panel":
            panel(p, -side * 1.9, y, face)
        elif kind == "sign":
            text = rng.choice((f"SECTOR {number:02d}", "DANGER", "EXIT >", "LEVEL -3", "NO ENTRY"))
            mat = p.mats[rng.choice(("dark", "yellow", "red"))]
            if last != "sign":  # two in a row would run into each other
                sign(text, 0.42, mat, (-side * 1.885, y, 1.75), (math.pi / 2, 0, math.pi / 2 * side))
        for dy in (-0.7, 0.9):
            if kind in ("crates", "sign") and p.free(-side * 1.45, y + dy, 0.32, 0.55):
                barrel(p, -side * 1.45, y + dy) if rng.random() < 0.6 else crate(
                    p, -side * 1.45, y + dy, 0.6, 0
                )
        number, last = number + 1, kind
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
