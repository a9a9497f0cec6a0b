"""The land side of the docks: houses, towers and hills, the quay with its goods and stalls, the water."""

import math

from docks_kit import WATER_Z, Mesh, shift, waving
from mathutils import Matrix, Vector

# --- houses -------------------------------------------------------------------------------------------------


def _window(m, x, z, w, h, y, rng, shutter):
    glass = "glass_lit" if rng.random() < 0.22 else "glass"
    m.box((x, y - 0.02, z), (w, 0.04, h), glass)
    for dx in (-w / 2, w / 2):
        m.box((x + dx, y - 0.06, z), (0.10, 0.12, h + 0.1), "timber")
    for dz in (-h / 2, h / 2):
        m.box((x, y - 0.06, z + dz), (w + 0.1, 0.12, 0.10), "timber")
    m.box((x, y - 0.05, z), (0.06, 0.06, h), "timber")
    m.box((x, y - 0.05, z + 0.1 * h), (w, 0.06, 0.06), "timber")
    if shutter:
        for side in (-1, 1):
            m.box((x + side * (w * 0.76), y - 0.06, z), (w * 0.45, 0.05, h), shutter, tint=rng.random())
    if rng.random() < 0.35:
        m.box((x, y - 0.2, z - h / 2 - 0.1), (w, 0.26, 0.2), "crate")
        for k in range(4):
            m.blob(
                (x + w * (k - 1.5) / 4, y - 0.22, z - h / 2 + 0.06),
                (0.17, 0.17, 0.14),
                "leaf" if k % 2 else rng.choice(["red", "yellow", "leaf"]),
                nu=6,
                nv=4,
            )


def _roof(m, w, d, y, z, rise, cover, rng):
    """Rows of tiles on two slopes; the ridge runs along x over a body w by d with its front at y."""
    half, eave = d / 2, 0.45
    slope = math.hypot(half, rise)
    rows = max(4, int((slope + eave) / 0.42))
    for side in (-1, 1):
        turn = Matrix.Rotation(side * -math.atan2(rise, half) + side * 0.05, 3, "X")
        for r in range(rows):
            s = (r + 0.5) / rows * (slope + eave) / slope
            across = side * (half * s) + y + half
            x = -0.35
            while x < w + 0.3:
                step = min(rng.uniform(0.5, 0.8), w + 0.36 - x)
                m.box((x + step / 2, across, z + rise * (1 - s)), (step - 0.015, 0.50, 0.07), cover, turn)
                x += step
    m.tube([(-0.36, y + half, z + rise + 0.06), (w + 0.36, y + half, z + rise + 0.06)], 0.13, cover, 6)


def _house(m, w, d, rng, tall=None):
    """A half-timbered house on local x 0..w, front at y = 0 facing -y."""
    plaster = rng.choice(["plaster_cream", "plaster_cream", "plaster_ochre", "plaster_rose", "plaster_blue"])
    shutter = rng.choice(["red", "blue", "green", None, "green"])
    cover = rng.choice(["tile", "tile", "tile", "slate"])
    storeys = tall or rng.choice([2, 2, 3])
    z, y = 0.0, 0.0
    bays = max(3, round(w / 1.7))
    posts = [w * i / bays for i in range(bays + 1)]
    door = rng.randrange(bays)
    for s in range(storeys):
        h = 3.0 if s == 0 else rng.uniform(2.4, 2.7)
        y -= 0.0 if s == 0 else 0.38
        ground = s == 0 and rng.random() < 0.5
        m.box((w / 2, (y + d) / 2, z + h / 2), (w, d - y, h), "stone" if ground else plaster, tint=0.5)
        if s:
            for x in posts:
                m.beam((x, y + 0.42, z - 0.55), (x, y + 0.02, z - 0.1), 0.14, 0.16, "timber")
        for edge in (z + 0.1, z + h - 0.1):
            m.box((w / 2, y - 0.02, edge), (w + 0.12, 0.16, 0.22), "timber")
            for x in (0, w):
                m.box((x, (y + d) / 2, edge), (0.14, d - y, 0.20), "timber")
        for x in posts:
            if not ground:
                m.box((x, y - 0.01, z + h / 2), (0.19, 0.14, h), "timber")
        for x in (0, w):
            for k in range(1, 4):
                m.box((x, y + (d - y) * k / 4, z + h / 2), (0.12, 0.18, h), "timber")
            m.beam((x, y + 0.2, z + 0.2), (x, y + (d - y) / 4, z + h - 0.2), 0.11, 0.16, "timber")
        for b in range(bays):
            x0, x1 = posts[b], posts[b + 1]
            middle = (x0 + x1) / 2
            if s == 0 and b == door:
                m.box(
                    (middle, y - 0.05, 1.1), (1.05, 0.10, 2.2), rng.choice(["crate", "green", "blue", "red"])
                )
                m.box((middle, y - 0.07, 2.25), (1.35, 0.18, 0.18), "timber")
                for side in (-0.6, 0.6):
                    m.box((middle + side, y - 0.07, 1.1), (0.16, 0.18, 2.2), "timber")
                m.box((middle, y - 0.35, 0.08), (1.4, 0.7, 0.16), "stone")
            elif rng.random() < 0.68:
                _window(m, middle, z + h * 0.55, min(0.95, (x1 - x0) * 0.52), 1.15, y, rng, shutter)
            elif not ground:
                lean = rng.choice((-1, 1))
                a, c = (x0, x1) if lean > 0 else (x1, x0)
                m.beam((a, y - 0.01, z + 0.15), (c, y - 0.01, z + h - 0.15), 0.10, 0.17, "timber")
        z += h
    rise = rng.uniform(2.6, 3.8)
    if rng.random() < 0.55:  # gable to the water
        half, keep = w / 2, m.at
        gable = [(0, y, z), (w, y, z), (half, y, z + rise)]
        m.add(gable, [(0, 1, 2)], [[(p[0], p[2]) for p in gable]], plaster, tint=0.5)
        m.beam((0, y - 0.02, z), (half, y - 0.02, z + rise), 0.14, 0.20, "timber")
        m.beam((w, y - 0.02, z), (half, y - 0.02, z + rise), 0.14, 0.20, "timber")
        m.box((half, y - 0.02, z + rise / 2), (0.18, 0.14, rise), "timber")
        m.box((half, y - 0.02, z + rise * 0.42), (w * 0.56, 0.14, 0.18), "timber")
        _window(m, half - w * 0.13, z + rise * 0.2, 0.7, 0.8, y, rng, None)
        _window(m, half + w * 0.13, z + rise * 0.2, 0.7, 0.8, y, rng, None)
        m.at = keep @ Matrix.Translation((w, y, 0)) @ Matrix.Rotation(math.pi / 2, 4, "Z")
        _roof(m, d - y, w, 0.0, z, rise, cover, rng)
        m.at = keep
    else:
        for x in (0, w):
            side = [(x, y, z), (x, d, z), (x, (y + d) / 2, z + rise)]
            m.add(side, [(0, 1, 2)], [[(p[1], p[2]) for p in side]], plaster, tint=0.5)
        _roof(m, w, d - y, y, z, rise, cover, rng)
    cx = rng.uniform(0.2, 0.8) * w
    m.box((cx, d * 0.55, z + rise * 0.75), (0.75, 0.75, rise * 1.1), "stone")
    m.box((cx, d * 0.55, z + rise * 1.3), (0.9, 0.9, 0.14), "stone")
    if rng.random() < 0.6:  # a hanging sign
        x = posts[rng.randrange(1, bays)]
        m.beam((x, -0.1, 2.75), (x, -1.3, 2.75), 0.06, 0.06, "iron")
        m.beam((x, -0.1, 3.2), (x, -1.0, 2.78), 0.05, 0.05, "iron")
        m.box((x, -0.85, 2.25), (0.07, 0.8, 0.7), rng.choice(["red", "blue", "green", "yellow"]))
        m.box((x, -0.85, 2.25), (0.10, 0.4, 0.3), "brass")


def add_town(rng, lane):
    """Rows of houses with lanes (one surely at x = lane), towers and the far shore."""
    m = Mesh(rng)
    spans, x = [], lane + 1.6
    while x < 75:
        w = rng.uniform(5.5, 8.5)
        spans.append((x, w))
        x += w + (rng.choice([0.15, 0.15, 3.0]))
    x = lane - 1.6
    while x > -65:
        w = rng.uniform(5.5, 8.5)
        x -= w
        spans.append((x, w))
        x -= rng.choice([0.15, 0.15, 3.0])
    for x, w in spans:
        m.at = shift(x, 10.2 + rng.uniform(-0.25, 0.35))
        _house(m, w, 8.5, rng)
    for x, w in spans[::2]:
        m.at = shift(x + 2.0, 22.5)
        _house(m, w + 2, 8.0, rng, tall=rng.choice([3, 4]))
    m.at = shift(lane + rng.choice((-14, 16)), 27)
    m.box((0, 0, 10), (5, 5, 20), "stone", tint=0.5)
    for side in (-1, 1):
        m.box((side * 1.1, -2.52, 16), (0.9, 0.1, 2.4), "timber")
        m.box((0, 0, 20 if side > 0 else 13.5), (5.5, 5.5, 0.4), "stone", tint=0.4)
    m.tube([(0, 0, 20.2), (0, 0, 30)], [3.4, 0.05], "slate", 8)
    m.at = Matrix()
    for x in (-66, 78):  # round towers close the quay
        m.tube([(x, 7, -3), (x, 7, 11)], 4.5, "stone", 20, tint=0.5)
        m.tube([(x, 7, 11), (x, 7, 12)], 5.0, "stone", 20, tint=0.4)
        m.tube([(x, 7, 12), (x, 7, 18)], [5.2, 0.1], "tile", 20)
    for row, (y, high) in enumerate(((-150, 9), (-210, 20), (-300, 34))):  # hills over the bay
        phase = rng.uniform(0, 9)

        def ridge(u, v, y=y, high=high, phase=phase):
            x = (u - 0.5) * 700
            z = high * (0.55 + 0.3 * math.sin(x * 0.021 + phase) + 0.15 * math.sin(x * 0.053 + 2 * phase))
            return Vector((x, y - 30 * v, WATER_Z - 0.5 + z * v)), (x, z * v)

        m.grid(ridge, 60, 2, "hill" if row < 2 else "far", tint=0.35 + 0.3 * row)
    for _ in range(26):  # a far town
        x, h = rng.uniform(-170, 230), rng.uniform(4, 9)
        m.box(
            (x, -146, h / 2), (rng.uniform(5, 9), 5, h), rng.choice(["plaster_cream", "far", "plaster_rose"])
        )
        m.tube([(x, -146, h), (x, -146, h + 4)], [5.0, 0.1], "tile", 4)
    m.object("town")


# --- quay and things on it ----------------------------------------------------------------------------------


def add_barrel(m, lying=False):
    keep = m.at
    if lying:
        m.at = (
            keep
            @ Matrix.Translation((0, 0, 0.34))
            @ Matrix.Rotation(math.pi / 2, 4, "X")
            @ Matrix.Translation((0, 0, -0.45))
        )
    bulge = [0.27, 0.33, 0.35, 0.33, 0.27]
    m.tube([(0, 0, 0.9 * i / 4) for i in range(5)], bulge, "crate", 14)
    for z, r in ((0.1, 0.295), (0.3, 0.34), (0.6, 0.34), (0.8, 0.295)):
        m.tube([(0, 0, z - 0.03), (0, 0, z + 0.03)], r + 0.008, "iron", 14)
    m.at = keep


def add_crate(m, s=0.9, goods=None):
    tint = m.rng.random()
    for k in range(4):
        z = s * (k + 0.5) / 4
        for side in (-1, 1):
            m.box(
                (0, side * s * 0.47, z),
                (s, 0.04, s / 4 - 0.025),
                "crate",
                tint=tint + m.rng.uniform(-0.15, 0.15),
            )
            m.box(
                (side * s * 0.47, 0, z),
                (0.04, s, s / 4 - 0.025),
                "crate",
                tint=tint + m.rng.uniform(-0.15, 0.15),
            )
    m.box((0, 0, s * 0.48), (s * 0.9, s * 0.9, s * (0.8 if goods else 0.95)), "pile")
    for a in (-1, 1):
        for b in (-1, 1):
            m.box((a * s * 0.47, b * s * 0.47, s / 2), (0.11, 0.11, s + 0.02), "crate", tint=0.2)
    if goods:
        for i in range(4):
            for j in range(4):
                p = ((i - 1.5) * s * 0.22, (j - 1.5) * s * 0.22, s * 0.92 + m.rng.uniform(0, 0.06))
                m.blob(p, (0.12, 0.12, 0.11), goods, nu=8, nv=5)
    else:
        for side in (-1, 1):
            m.beam(
                (-s * 0.45, side * s * 0.5, 0.1 * s),
                (s * 0.45, side * s * 0.5, 0.9 * s),
                0.04,
                0.11,
                "crate",
                tint=0.2,
            )


def add_basket(m, goods):
    m.tube([(0, 0, 0), (0, 0, 0.2), (0, 0, 0.4)], [0.28, 0.36, 0.42], "sack", 12)
    for k in range(9):
        a, r = k * 2.4, 0.28 if k else 0.0
        m.blob((r * math.cos(a), r * math.sin(a), 0.42 if k else 0.5), (0.13, 0.13, 0.12), goods, nu=8, nv=5)


def add_goods(m, rng):
    """One cluster about 1.6 m across."""
    base = m.at
    kind = rng.randrange(6)
    if kind == 0:
        for dx, dy in ((-0.4, 0), (0.38, 0.1), (0.0, 0.62)):
            m.at = base @ shift(dx, dy, 0, rng.uniform(0, 6))
            add_barrel(m)
        m.at = base @ shift(0.0, 0.2, 0.9)
        add_barrel(m)
    elif kind == 1:
        for dx, z in ((-0.55, 0), (0.5, 0), (0.0, 0.92)):
            m.at = base @ shift(dx, 0, z, rng.uniform(-0.25, 0.25))
            add_crate(m, 0.92)
    elif kind == 2:
        for k in range(6):
            a = k * 1.2
            m.at = base
            r = 0.5 if k < 5 else 0.05
            m.blob((r * math.cos(a), r * math.sin(a), 0.28 if k < 5 else 0.62), (0.36, 0.30, 0.30), "sack")
            m.tube(
                [
                    (r * math.cos(a), r * math.sin(a), 0.5 if k < 5 else 0.85),
                    (r * math.cos(a), r * math.sin(a), 0.72 if k < 5 else 1.08),
                ],
                [0.07, 0.13],
                "sack",
                7,
            )
    elif kind == 3:
        for k in range(3):
            m.at = base @ shift((k - 1) * 0.9, rng.uniform(-0.2, 0.2), 0, rng.uniform(-0.2, 0.2))
            add_crate(m, 0.7, rng.choice(["red", "yellow", "green"]))
    elif kind == 4:
        for k in range(3):
            m.at = base @ shift((k - 1) * 0.72, 0, 0)
            add_barrel(m, lying=True)
        m.at = base @ shift(-0.36, 0, 0.6)
        add_barrel(m, lying=True)
    else:
        for k in range(4):
            m.at = base @ shift((k % 2 - 0.5) * 0.9, (k // 2 - 0.5) * 0.9)
            add_basket(m, rng.choice(["red", "yellow", "green", "white"]))
    m.at = base


def add_coil(m):
    for k in range(4):
        r = 0.42 - 0.03 * k
        m.tube(
            [(r * math.cos(a * 0.42), r * math.sin(a * 0.42), 0.05 + 0.09 * k) for a in range(16)],
            0.05,
            "rope",
            6,
        )


def add_lamp(m):
    m.box((0, 0, 1.6), (0.13, 0.13, 3.2), "timber")
    m.beam((0, 0, 3.1), (0, -0.8, 3.1), 0.08, 0.08, "timber")
    m.beam((0, 0, 2.6), (0, -0.5, 3.08), 0.06, 0.06, "timber")
    m.box((0, -0.75, 2.72), (0.22, 0.22, 0.34), "glow")
    for a in (-0.13, 0.13):
        for b in (-0.13, 0.13):
            m.box((a, -0.75 + b, 2.72), (0.045, 0.045, 0.4), "iron")
    m.tube([(0, -0.75, 2.92), (0, -0.75, 3.08)], [0.24, 0.03], "iron", 8)


def add_stall(rng, x, y, frames, time):
    """A market stall with a striped awning that breathes."""
    m = Mesh(rng, shift(x, y))
    for a in (-1.5, 1.5):
        for b, h in ((-1.1, 2.15), (1.1, 2.7)):
            m.box((a, b, h / 2), (0.10, 0.10, h), "timber")
    m.box((0, -0.8, 0.9), (3.1, 0.9, 0.09), "crate")
    m.box((0, -1.2, 0.45), (3.0, 0.05, 0.85), rng.choice(["red", "blue", "green", "crate"]))
    for k in range(4):
        m.at = shift(x - 1.1 + 0.74 * k, y - 0.85, 0.95)
        add_basket(m, rng.choice(["red", "yellow", "green", "white"])) if k % 2 else add_crate(
            m, 0.6, rng.choice(["red", "yellow", "green"])
        )
    m.object("stall")
    cloth = Mesh(rng, shift(x, y))

    def shape(u, v):
        if v > 0.85:  # the hanging edge
            p = Vector(((u - 0.5) * 3.5, -1.55, 2.05 - (v - 0.85) * 2.4 * (0.8 + 0.2 * math.cos(u * 40))))
        else:
            p = Vector(
                (
                    (u - 0.5) * 3.5,
                    1.3 - v / 0.85 * 2.85,
                    2.78 - 0.73 * v / 0.85 - 0.10 * math.sin(math.pi * v / 0.85),
                )
            )
        return p, (u * 3.5, v * 3.0)

    cloth.grid(shape, 28, 14, rng.choice(["awning_red", "awning_blue", "awning_green"]))
    start = rng.uniform(0, 6)
    waving(
        cloth.object("awning"),
        frames,
        [
            (
                lambda p: (Vector((0, 0.05 if p.z < 2.0 else 0.0, 0.035)), 2.2 * (p.x - x) + p.y),
                0.30,
                start + time * 0.30,
            )
        ],
    )


def add_quay(rng, pier_x):
    m = Mesh(rng)
    x = -64.0
    while x < 76:
        w = rng.uniform(0.21, 0.29)
        m.box(
            (x + w / 2, 2.5 + rng.uniform(-0.04, 0.04), -0.05 + rng.uniform(-0.008, 0.008)),
            (w - 0.028, 5.1, 0.1),
            "plank",
        )
        for y in (0.22, 2.5, 4.75):
            m.box((x + w / 2 + 0.05, y, 0.004), (0.045, 0.045, 0.02), "iron")
        x += w
    m.box((6, 2.6, -0.6), (140, 5.0, 0.9), "pile", tint=0.1)
    m.box((6, -0.10, -0.14), (140, 0.24, 0.34), "pile")
    m.box((6, 5.12, 0.0), (140, 0.26, 0.16), "pile")
    ground = [(-70, 5.2, 0), (82, 5.2, 0), (82, 60, 0), (-70, 60, 0)]
    m.add(ground, [(0, 1, 2, 3)], [[(p[0], p[1]) for p in ground]], "cobble", tint=0.5)
    posts = []
    for k in range(56):
        x = -64 + 2.5 * k + rng.uniform(-0.2, 0.2)
        tall = k % 3 == 0
        m.tube([(x, -0.3, -3), (x, -0.3, 0.95 if tall else 0.1)], 0.17, "pile", 9)
        if tall:
            posts.append(x)
            for z in (0.5, 0.58, 0.66):
                m.tube(
                    [(x + 0.2 * math.cos(a * 0.63), -0.3 + 0.2 * math.sin(a * 0.63), z) for a in range(11)],
                    0.045,
                    "rope",
                    5,
                )
        else:
            m.beam((x, -0.28, -2), (x + 2.4, -0.28, -0.4), 0.12, 0.12, "pile")
    for px in pier_x:
        y = 0.0
        while y > -13:
            w = rng.uniform(0.21, 0.29)
            m.box(
                (px, y - w / 2, -0.12 + rng.uniform(-0.01, 0.01)),
                (2.5 + rng.uniform(-0.1, 0.1), w - 0.03, 0.09),
                "plank",
            )
            y -= w
        for side in (-1, 1):
            m.box((px + side * 1.05, -6.4, -0.27), (0.2, 13, 0.2), "pile")
            for k in range(5):
                top = rng.uniform(0.6, 1.1)
                m.tube(
                    [(px + side * 1.28, -2.0 - 2.6 * k, -3), (px + side * 1.28, -2.0 - 2.6 * k, top)],
                    0.14,
                    "pile",
                    8,
                )
            for k in range(4):
                a, b = -2.0 - 2.6 * k, -4.6 - 2.6 * k
                m.rope((px + side * 1.28, a, 0.5), (px + side * 1.28, b, 0.5), 0.03, 0.16)
    m.object("quay")
    return posts


def add_water(rng, frames, time):
    def line(edges):
        return [a + (b - a) * i / n for a, b, n in edges for i in range(n)] + [edges[-1][1]]

    xs = line([(-400, -60, 6), (-60, 75, 270), (75, 420, 6)])
    ys = line([(-330, -45, 6), (-45, -22, 30), (-22, 1, 56)])
    m = Mesh(rng)

    def shape(u, v):
        x, y = xs[round(u * (len(xs) - 1))], ys[round(v * (len(ys) - 1))]
        return Vector((x, y, WATER_Z)), (x, y)

    m.grid(shape, len(xs) - 1, len(ys) - 1, "water", tint=0.5)

    def wave(kx, ky, high):
        def displace(p):
            fade = min(1.0, max(0.0, (p.y + 44) / 20)) * min(1.0, max(0.0, (72 - abs(p.x - 7)) / 10))
            return Vector((0, 0, high * fade)), kx * p.x + ky * p.y

        return displace

    waves = [
        (wave(0.9, 1.3, 0.030), 0.20, 0.2 * time),
        (wave(-1.9, 1.1, 0.014), 0.27, 0.27 * time),
        (wave(0.3, -2.9, 0.009), 0.33, 0.33 * time),
    ]
    waving(m.object("water"), frames, waves)
