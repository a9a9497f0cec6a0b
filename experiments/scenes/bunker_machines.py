"""The bunker's machines: fan, overhead crane, robot arm, piston pump and gears; tanks, which stand still.

Every function builds one machine at a place of the world (metres, z up) and keys it on frames 0..frames+1.
Angular speeds are radians a frame.
"""

import math
import sys
from pathlib import Path

from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common as co
from bunker_kit import spin
from bunker_parts import Place


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
