"""What moves at the docks: ships, boats, cranes, people, carts, gulls, flags. All key-framed exactly."""

import math

from docks_kit import WATER_Z, Mesh, keyed, shift, waving
from docks_town import add_barrel, add_basket, add_crate
from mathutils import Matrix, Vector

# --- ships --------------------------------------------------------------------------------------------------


def add_hull(m, length, beam, side, paint, stripe):
    """A round cog, waterline at z = 0, bow towards +x; returns sheer(t) -> (x, half width, top)."""

    def sheer(t):
        s = 2 * t - 1
        half = beam / 2 * max(0.02, 1 - abs(s) ** (2.6 if s > 0 else 4.0)) ** 0.75
        return (t - 0.5) * length, half, side + 1.3 * abs(s) ** 2.4

    strakes = 9
    for j in range(strakes):
        for hand in (-1, 1):

            def plank(u, v, j=j, hand=hand):
                x, half, top = sheer(u)
                k = (j + v) / strakes
                rake = 1.2 * (2 * u - 1) * (1 - k)
                return Vector((x + rake, hand * half * (1 - 0.9 * k**2.4), top + (-0.9 - top) * k)), (
                    x,
                    k * 3,
                )

            colour = stripe if j == 1 else paint
            m.grid(plank, 22, 1, colour, tint=0.2 + 0.6 * m.rng.random() if j != 1 else 0.5)
    for k, thick in ((0.0, 0.11), (0.25, 0.08), (0.48, 0.08)):
        for hand in (-1, 1):
            path = []
            for i in range(23):
                x, half, top = sheer(i / 22)
                path.append(
                    (
                        x + 1.2 * (2 * i / 22 - 1) * (1 - k),
                        hand * (half * (1 - 0.9 * k**2.4) + 0.03),
                        top + (-0.9 - top) * k,
                    )
                )
            m.tube(path, thick, "timber", 6)
    for i in range(22):
        (x0, h0, _), (x1, h1, _) = sheer(i / 22), sheer((i + 1) / 22)
        z = side - 0.55
        deck = [(x0, -h0, z), (x1, -h1, z), (x1, h1, z), (x0, h0, z)]
        m.add(deck, [(0, 1, 2, 3)], [[(p[0], p[1]) for p in deck]], "plank")
    return sheer


def _castle(m, x0, x1, half, z, paint):
    m.box(((x0 + x1) / 2, 0, z), (x1 - x0, half * 2, 0.14), "plank")
    for hand in (-1, 1):
        n = 5
        for k in range(n + 1):
            x = x0 + (x1 - x0) * k / n
            m.box((x, hand * half, z - 0.2), (0.12, 0.12, 2.0), "timber")
            if k < n:
                m.box(
                    (x + (x1 - x0) / n / 2, hand * half, z + 0.32),
                    ((x1 - x0) / n - 0.1, 0.07, 0.5),
                    paint[k % 2],
                )
        m.box(((x0 + x1) / 2, hand * half, z + 0.78), (x1 - x0 + 0.2, 0.14, 0.10), "timber")
    for x in (x0, x1):
        m.box((x, 0, z + 0.32), (0.07, half * 2, 0.5), paint[0])
        m.box((x, 0, z + 0.78), (0.14, half * 2 + 0.1, 0.10), "timber")


def add_flag(rng, parent, at, length, height, frames, time, colour):
    """A flag flying to local +x from a hoist at x = 0; waves grow towards the fly."""
    m = Mesh(rng)
    m.grid(
        lambda u, v: (Vector((u * length, 0, -v * height * (1 - 0.45 * u))), (v * height * 2, u)),
        16,
        5,
        colour,
        tint=0.6,
    )
    start = rng.uniform(0, 6)
    wind = [
        (
            lambda p: (Vector((0, 0.16 * p.x, 0.05 * p.x)), 4.5 * p.x / max(1.0, length * 0.7) + 0.6 * p.z),
            0.75,
            start + 0.75 * time,
        )
    ]
    waving(m.object("flag", parent, at), frames, wind)


def add_ship(rng, x, y, turn, frames, time, length, posts=()):
    """A moored ship that bobs and rolls, with masts, rigging, sails and flags."""
    beam, side = length * 0.30, 1.45 + 0.03 * length
    masts = [0.56] if length < 12.5 else [0.42, 0.72]
    m = Mesh(rng)
    paint = rng.choice(["hull_brown", "hull_dark", "hull_honey", "hull_brown"])
    accent = rng.choice(
        [("red", "white"), ("blue", "yellow"), ("green", "yellow"), ("red", "yellow"), ("blue", "white")]
    )
    sheer = add_hull(m, length, beam, side, paint, accent[0])
    _castle(m, -length / 2 - 0.3, -length * 0.26, beam * 0.42, side + 1.25, accent)
    if length > 11:
        _castle(m, length * 0.34, length / 2 + 0.2, beam * 0.30, side + 1.35, accent)
    m.box((-length / 2 - 0.35, 0, 0.6), (0.16, 0.22, 3.4), "timber")
    bow = Vector((length / 2 + 0.8, 0, side + 1.3))
    tip = bow + Vector((2.6, 0, 1.5))
    m.tube([bow - Vector((1.6, 0, 0.9)), tip], [0.15, 0.08], "mast", 8)
    top_flags, sails = [], []
    for number, t in enumerate(masts):
        mx = (t - 0.5) * length
        high = (0.92 if number == 0 else 0.74) * (length * 0.55 + 5.0)
        m.tube([(mx, 0, side - 0.6), (mx, 0, side + high)], [0.20, 0.09], "mast", 9)
        top_flags.append((mx, side + high))
        nest = side + high * 0.80
        m.tube([(mx, 0, nest - 0.35), (mx, 0, nest), (mx, 0, nest + 0.55)], [0.22, 0.55, 0.62], "timber", 12)
        z, span = side + high * 0.70, beam * 0.62 + high * 0.13
        brace = rng.uniform(-0.35, 0.35)
        ends = [
            Vector((mx + 0.25 + s * span * math.sin(brace), s * span * math.cos(brace), z)) for s in (-1, 1)
        ]
        m.tube([ends[0], (ends[0] + ends[1]) / 2, ends[1]], [0.07, 0.13, 0.07], "mast", 8)
        sails.append((z, span, ends, high))
        for hand in (-1, 1):
            feet = []
            for dt in (-0.085, -0.03, 0.025):
                fx, half, top = sheer(min(0.95, t + dt))
                foot, head = Vector((fx, hand * half * 1.02, top)), Vector((mx, hand * 0.10, nest - 0.1))
                m.rope(foot, head, 0.024, material="tar_rope")
                m.blob(foot + Vector((0, 0, 0.12)), (0.08, 0.06, 0.10), "timber", nu=6, nv=4)
                feet.append((foot, head))
            for k in range(1, 12):  # ratlines
                a, b = feet[0][0].lerp(feet[0][1], k / 13), feet[2][0].lerp(feet[2][1], k / 13)
                m.rope(a, b, 0.016, material="tar_rope")
            m.rope(ends[(hand + 1) // 2], (mx, 0, z + high * 0.16), 0.02)
            m.rope(ends[(hand + 1) // 2], (-length / 2 + 0.4, hand * beam * 0.3, side + 2.0), 0.018, 0.25)
        m.rope(
            (mx, 0, side + high * 0.93),
            tip if number == len(masts) - 1 else ((masts[1] - 0.5) * length, 0, side + high * 0.5),
            0.026,
            0.1,
            "tar_rope",
        )
        m.rope((mx, 0, side + high * 0.93), (-length / 2 - 0.2, 0, side + 2.0), 0.026, 0.15, "tar_rope")
    for _ in range(2):
        m.at = shift(
            rng.uniform(-0.15, 0.2) * length, rng.uniform(-0.2, 0.2) * beam, side - 0.55, rng.uniform(0, 6)
        )
        rng.choice([add_barrel, add_crate])(m)
    m.at = Matrix()
    hull = m.object("ship")
    bob, roll, pitch = rng.uniform(0.05, 0.09), rng.uniform(0.030, 0.055), rng.uniform(0.006, 0.012)
    speed, start = rng.uniform(0.10, 0.15), rng.uniform(0, 6) + time

    def sway(f):
        return (
            bob * math.sin(speed * f + start),
            roll * math.sin(0.83 * speed * f + 1.7 * start),
            pitch * math.sin(1.1 * speed * f + 0.6 * start),
        )

    def pose(f):
        up, rx, ry = sway(f)
        return (x, y, WATER_Z + up), (rx, ry, turn)

    keyed(hull, frames, pose)
    for z, span, ends, high in sails:
        cloth = rng.choice(["sail", "sail_red", "sail_blue", "sail"])
        s = Mesh(rng)
        if rng.random() < 0.5:  # furled
            n = 18
            path = [
                ends[0].lerp(ends[1], 0.06 + 0.88 * i / n)
                - Vector((-0.05, 0, 0.20 + 0.05 * math.sin(math.pi * i / n)))
                for i in range(n + 1)
            ]
            s.tube(
                path,
                [
                    0.10 + 0.15 * math.sin(math.pi * i / n) ** 0.5 - (0.06 if i % 3 == 0 else 0.0)
                    for i in range(n + 1)
                ],
                "sail",
                9,
            )
            for i in range(3, n, 3):
                s.tube([path[i] - Vector((0, 0.03, 0)), path[i] + Vector((0, 0.03, 0))], 0.23, "rope", 9)
            s.object("furled sail", hull)
        else:  # hanging in a belly
            drop = high * rng.uniform(0.36, 0.46)
            across = (ends[1] - ends[0]).normalized()
            out = across.cross(Vector((0, 0, 1)))

            def shape(u, v, ends=ends, drop=drop, out=out, span=span):
                p = ends[0].lerp(ends[1], 0.05 + 0.9 * u * (1 - 0.08 * v) + 0.036 * v)
                belly = (
                    math.sin(math.pi * min(1.0, v * 0.9 + 0.05))
                    * (0.35 + 0.65 * math.sin(math.pi * u))
                    * 0.85
                )
                foot = 0.35 * v * math.sin(math.pi * u)
                return p - Vector((0, 0, 0.12 + v * drop - foot)) + out * belly, (
                    (u - 0.5) * 2 * span,
                    v * drop,
                )

            s.grid(shape, 22, 14, cloth, tint=0.6)
            made = s.object("sail", hull)

            def flutter(p, z=z, drop=drop, out=out):
                return out * (0.10 * max(0.0, (z - p.z) / drop)), 1.3 * p.y - 1.1 * p.z

            waving(made, frames, [(flutter, 0.42, rng.uniform(0, 6) + 0.42 * time)])
    for mx, z in top_flags:
        add_flag(
            rng,
            hull,
            Matrix.Translation((mx, 0, z)) @ Matrix.Rotation(0.9 - turn, 4, "Z"),
            2.0,
            0.75,
            frames,
            time,
            rng.choice(accent),
        )
    for (
        post,
        t,
        hand,
    ) in posts:  # mooring ropes follow the ship with the weight 0 at the post and 1 at the rail
        px, half, top = sheer(t)
        rail = Vector((px, hand * half, top))
        place_ship = Matrix.Translation((x, y, WATER_Z)) @ Matrix.Rotation(turn, 4, "Z")
        end, post = place_ship @ rail, Vector(post)
        r = Mesh(rng)
        r.rope(post, end, 0.035, 0.22, parts=10)
        line = r.object("mooring rope")
        span = (end - post).length
        rest = [v.co.copy() for v in line.data.vertices]
        line.shape_key_add(name="rest", from_mix=False)
        lift = Vector((0, 0, 1))
        heel = place_ship.to_3x3() @ Vector((0, -rail.z, rail.y))
        for index, move in enumerate((lift, heel)):
            key = line.shape_key_add(name=f"move{index}", from_mix=False)
            key.slider_min, key.slider_max = -1.0, 1.0
            key.data.foreach_set(
                "co", [c for p in rest for c in p + move * min(1.0, (p - post).length / span)]
            )
            for f in range(frames + 2):
                key.value = sway(f)[index]
                key.keyframe_insert("value", frame=f)


# --- things that move ---------------------------------------------------------------------------------------


def add_crane(rng, x, y, frames, time):
    """A wooden crane that slews a little, with a crate swinging from its jib."""
    m = Mesh(rng)
    m.box((0, 0, 2.4), (0.42, 0.42, 4.8), "timber")
    for a in range(4):
        c, s = math.cos(a * math.pi / 2 + 0.78), math.sin(a * math.pi / 2 + 0.78)
        m.beam((c * 1.3, s * 1.3, 0.08), (0, 0, 1.9), 0.16, 0.16, "timber")
        m.beam((c * 1.5, s * 1.5, 0.1), (0, 0, 0.1), 0.24, 0.2, "timber")
    m.object("crane foot", None, shift(x, y))
    top = Mesh(rng)
    tip = Vector((4.2, 0, 2.3))
    top.beam((-1.5, 0, 0.1), (0.9, 0, 0.1), 0.36, 0.3, "pile")
    top.beam((-0.9, 0, 0.1), tip, 0.24, 0.28, "pile")
    top.beam((0.2, 0, 0.2), (0.2, 0, 2.0), 0.24, 0.24, "pile")
    top.beam((0.2, 0, 1.9), tip, 0.10, 0.10, "pile")
    top.beam((-1.4, 0, 0.2), (0.2, 0, 1.9), 0.12, 0.12, "pile")
    top.tube([(-1.1, -0.5, 0.55), (-1.1, 0.5, 0.55)], 0.36, "crate", 14)
    top.tube([(-1.1, -0.34, 0.55), (-1.1, 0.34, 0.55)], 0.40, "rope", 14)
    top.tube([tip + Vector((0, -0.1, -0.1)), tip + Vector((0, 0.1, -0.1))], 0.22, "iron", 12)
    top.rope((-1.1, 0, 0.9), (0.2, 0, 2.05), 0.03)
    top.rope((0.2, 0, 2.05), tip, 0.03)
    jib = top.object("crane jib")
    slew, start = -math.pi / 2 + rng.uniform(-0.7, 0.7), rng.uniform(0, 6) + time
    rate = rng.choice((-1, 1)) * rng.uniform(0.008, 0.014)
    keyed(jib, frames, lambda f: ((x, y, 4.8), (0, 0, slew + rate * (f - frames / 2))))
    load = Mesh(rng, Matrix.Translation((0, 0, 0)))
    drop = rng.uniform(2.9, 4.0)
    load.rope((0, 0, 0), (0, 0, -drop), 0.03)
    for a in (-1, 1):
        for b in (-1, 1):
            load.rope((0, 0, -drop), (a * 0.5, b * 0.5, -drop - 0.75), 0.022)
    load.at = Matrix.Translation((0, 0, -drop - 1.75))
    add_crate(load, 1.05)
    hung = load.object("hanging crate", jib)
    keyed(
        hung,
        frames,
        lambda f: (
            tip - Vector((0, 0, 0.3)),
            (0.11 * math.sin(0.21 * f + start), 0.16 * math.sin(0.18 * f + 1.3 * start), 0.03 * f),
        ),
    )


def add_person(rng, name="person"):
    m = Mesh(rng)
    robe, over = (
        rng.choice(["red", "blue", "green", "yellow", "sack", "hull_brown"]),
        rng.choice(["sack", "timber", "white", "red", "blue"]),
    )
    m.tube(
        [(0, 0, 0.02), (0, 0, 0.55), (0, 0, 0.98), (0, 0, 1.28), (0, 0, 1.46)],
        [0.30, 0.25, 0.18, 0.23, 0.09],
        robe,
        12,
    )
    m.tube([(0, 0, 0.94), (0, 0, 1.02)], 0.195, "timber", 12)
    m.blob((0, 0, 1.60), (0.115, 0.115, 0.145), "skin")
    m.tube([(0, 0, 1.64), (0, 0, 1.67), (0, 0, 1.70), (0, 0, 1.84)], [0.22, 0.22, 0.13, 0.05], over, 12)
    for side in (-1, 1):
        m.tube(
            [(0, side * 0.22, 1.38), (0.06, side * 0.30, 1.12), (0.26, side * 0.24, 0.98)],
            [0.085, 0.085, 0.06],
            over,
            8,
        )
        m.blob((0.30, side * 0.23, 0.98), (0.06, 0.06, 0.06), "skin", nu=6, nv=4)
    if rng.random() < 0.4:
        m.at = shift(0.42, 0, 0.72)
        add_basket(m, rng.choice(["red", "yellow", "green"]))
    return m.object(name)


def walk(obj, frames, x, y, heading, pace, phase):
    def pose(f):
        s = pace * (f - frames / 2)
        where = (x + s * math.cos(heading), y + s * math.sin(heading), 0.03 * abs(math.sin(0.42 * f + phase)))
        return where, (0.05 * math.sin(0.42 * f + phase), 0.03, heading + 0.06 * math.sin(0.42 * f + phase))

    keyed(obj, frames, pose)


def add_cart(rng, x, y, heading, pace, frames):
    """A handcart whose wheels turn with the way it goes, and the one who pushes it."""
    m = Mesh(rng)
    m.box((0, 0, 0.72), (1.9, 1.05, 0.08), "crate")
    for side in (-1, 1):
        m.box((0, side * 0.5, 0.92), (1.9, 0.06, 0.34), "crate")
        m.beam((-0.9, side * 0.4, 0.75), (-2.0, side * 0.4, 0.98), 0.07, 0.07, "timber")
    m.tube([(0, -0.75, 0.52), (0, 0.75, 0.52)], 0.06, "iron", 8)
    for dx in (-0.55, 0.15, 0.65):
        m.blob((dx, rng.uniform(-0.2, 0.2), 1.05), (0.34, 0.32, 0.27), "sack")
    m.at = shift(0.1, 0.0, 1.05)
    add_basket(m, rng.choice(["red", "yellow", "green"]))
    cart = m.object("cart")
    keyed(
        cart,
        frames,
        lambda f: (
            (
                x + pace * (f - frames / 2) * math.cos(heading),
                y + pace * (f - frames / 2) * math.sin(heading),
                0,
            ),
            (0, 0.02 * math.sin(0.9 * f), heading),
        ),
    )
    for side in (-1, 1):
        w = Mesh(rng)
        rim = [(0.50 * math.cos(a * math.pi / 10), 0, 0.50 * math.sin(a * math.pi / 10)) for a in range(21)]
        w.tube(rim, 0.055, "timber", 6)
        for k in range(8):
            a = k * math.pi / 4
            w.tube([(0, 0, 0), (0.5 * math.cos(a), 0, 0.5 * math.sin(a))], 0.035, "crate", 6)
        w.tube([(0, -0.1, 0), (0, 0.1, 0)], 0.10, "iron", 10)
        wheel = w.object("wheel", cart)
        keyed(wheel, frames, lambda f, side=side: ((0, side * 0.68, 0.52), (0, pace * f / 0.52, 0)))
    walk(
        add_person(rng, "carter"),
        frames,
        x - 2.15 * math.cos(heading),
        y - 2.15 * math.sin(heading),
        heading,
        pace,
        rng.uniform(0, 6),
    )


def add_rowboat(rng, x, y, heading, pace, frames, time):
    m = Mesh(rng)
    sheer = add_hull(
        m,
        4.2,
        1.5,
        0.42,
        rng.choice(["hull_honey", "hull_brown"]),
        rng.choice(["red", "blue", "white", "green"]),
    )
    del sheer
    for dx in (-0.9, 0.5):
        m.box((dx, 0, 0.36), (0.3, 1.3, 0.06), "crate")
    boat = m.object("rowing boat")

    def pose(f):
        s = pace * (f - frames / 2) + 0.10 * math.sin(0.35 * f + time)
        return (
            x + s * math.cos(heading),
            y + s * math.sin(heading),
            WATER_Z + 0.05 + 0.03 * math.sin(0.3 * f + time),
        ), (0.04 * math.sin(0.25 * f + time), 0.02 * math.sin(0.35 * f), heading)

    keyed(boat, frames, pose)
    rower = add_person(rng, "rower")
    rower.parent = boat
    keyed(rower, frames, lambda f: ((0.35, 0, -0.25), (0, 0.25 * math.sin(0.35 * f + time), math.pi)))
    for side in (-1, 1):
        o = Mesh(rng)
        o.tube([(0, -side * 0.5, 0.12), (0, side * 1.9, -0.42)], 0.035, "mast", 6)
        o.beam((0, side * 1.8, -0.40), (0, side * 2.4, -0.53), 0.16, 0.04, "mast")
        oar = o.object("oar", boat)
        keyed(
            oar,
            frames,
            lambda f, side=side: (
                (-0.1, side * 0.72, 0.5),
                (side * 0.13 * math.cos(0.35 * f + time), 0, side * 0.5 * math.sin(0.35 * f + time)),
            ),
        )


def add_gull(rng, centre, frames):
    m = Mesh(rng)
    m.tube(
        [(-0.42, 0, 0), (-0.2, 0, 0), (0.1, 0, 0.02), (0.3, 0, 0.04), (0.42, 0, 0.02)],
        [0.03, 0.08, 0.11, 0.07, 0.02],
        "white",
        8,
    )
    m.tube([(0.40, 0, 0.02), (0.50, 0, 0.0)], [0.025, 0.01], "yellow", 5)
    gull = m.object("gull")
    heading, pace, phase, beat = (
        rng.uniform(0, 6.28),
        rng.uniform(0.14, 0.24),
        rng.uniform(0, 6),
        rng.uniform(0.7, 1.0),
    )
    bend = rng.uniform(-0.02, 0.02)

    def pose(f):
        s, a = pace * (f - frames / 2), heading + bend * (f - frames / 2)
        return centre + Vector((s * math.cos(a), s * math.sin(a), 0.05 * math.sin(beat * f + phase))), (
            8 * bend,
            0,
            a,
        )

    keyed(gull, frames, pose)
    for side in (-1, 1):
        w = Mesh(rng)
        wing = [
            (0.14, 0, 0),
            (-0.12, 0, 0),
            (-0.10, side * 0.5, 0.07),
            (0.10, side * 0.5, 0.07),
            (-0.20, side * 0.98, 0.02),
            (-0.10, side * 0.98, 0.02),
        ]
        w.add(wing, [(0, 1, 2, 3), (3, 2, 4, 5)], [[(0, 0)] * 4] * 2, "white", 0.7)
        keyed(
            w.object("wing", gull),
            frames,
            lambda f, side=side: (
                (0, side * 0.06, 0.05),
                (side * (0.15 + 0.55 * math.sin(beat * f + phase)), 0, 0),
            ),
        )


def add_bunting(rng, a, b, frames, time):
    """A line of pennants between two points."""
    line = Mesh(rng)
    line.rope(a, b, 0.022, 0.5, parts=12)
    line.object("bunting line")
    m, a, b = Mesh(rng), Vector(a), Vector(b)
    n = max(4, int((b - a).length / 0.55))
    along = (b - a).normalized()
    for k in range(n):
        t = (k + 0.5) / n
        p = a.lerp(b, t) - Vector((0, 0, 2.0 * t * (1 - t)))
        m.add(
            [p - along * 0.2, p + along * 0.2, p - Vector((0, 0, 0.5))],
            [(0, 1, 2)],
            [[(0, 0), (1, 0), (0, 1)]],
            ("red", "yellow", "blue", "white")[k % 4],
            0.6,
        )
    wind = along.cross(Vector((0, 0, 1)))
    height = {i: (0.0 if i % 3 < 2 else 0.16) for i in range(3 * n)}
    order = iter(range(3 * n))
    waving(
        m.object("bunting"),
        frames,
        [(lambda p: (wind * height[next(order)], 1.7 * (p - a).dot(along)), 0.6, 0.6 * time)],
    )
