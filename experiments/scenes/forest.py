"""Forest: old trunks, ferns and a winding path under a canopy with sun patches that move with the branches.

Each clip is a forest of its own, drawn from (seed, split, clip), with one of five camera moves.
Swaying plants, lanterns, drifting leaves, birds and butterflies
are rigid objects keyed on every frame 0..frames+1.
"""

import math
import random
import sys
from pathlib import Path
from typing import NamedTuple

import bpy
from mathutils import Matrix, Vector, kdtree, noise

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common
import forest_parts as parts

SETTINGS = {
    "test_samples": 32,
    "train_samples": 8,
    "denoise": False,
    "max_bounces": 2,
    "diffuse_bounces": 0,
    "glossy_bounces": 1,
    "exposure": 1.3,
}

SHOTS = ("walk", "dolly", "low", "orbit", "back")
FOV_DEG = 64.0


class Shot(NamedTuple):
    """One camera move: positions and targets, as (x, y, height above ground), from frame 0 to frames+1."""

    kind: str
    points: list[tuple[float, float, float]]
    targets: list[tuple[float, float, float]]

    @property
    def heading(self) -> float:
        """Angle of the mean view direction in the ground plane."""
        point, target = (Vector(curve[len(curve) // 2]) for curve in (self.points, self.targets))
        return math.atan2(target.y - point.y, target.x - point.x)

    @property
    def centre(self) -> Vector:
        """Mean camera position in the ground plane."""
        return Vector(self.points[len(self.points) // 2]).xy


def smooth(low: float, high: float, value: float) -> float:
    """Smooth step from 0 at `low` to 1 at `high`."""
    t = min(1.0, max(0.0, (value - low) / (high - low)))
    return t * t * (3 - 2 * t)


class Terrain:
    """The winding path and the ground's height."""

    def __init__(self, rng: random.Random):
        self.waves = [
            (rng.uniform(0.9, 1.5), rng.uniform(0.16, 0.22), rng.uniform(0, math.tau)),
            (0.5, 0.43, 1.3),
        ]
        self.offset = rng.uniform(0, 500)
        self.origin = sum(a * math.sin(p) for a, _, p in self.waves)
        self.pond: tuple[Vector, float] | None = None

    def path_x(self, y: float) -> float:
        """x of the path's middle at y; 0 at y = 0."""
        return sum(a * math.sin(k * y + p) for a, k, p in self.waves) - self.origin

    def from_path(self, x: float, y: float) -> float:
        """Distance from the path's middle, roughly."""
        slope = (self.path_x(y + 0.1) - self.path_x(y - 0.1)) / 0.2
        return abs(x - self.path_x(y)) / math.sqrt(1 + slope * slope)

    def height(self, x: float, y: float) -> float:
        """Ground height: level path, banks beside it, a hollow where the pond is."""
        off = self.from_path(x, y)
        rolling = 0.55 * noise.noise((x * 0.13, y * 0.13, self.offset))
        bumps = 0.16 * noise.noise((x * 0.5, y * 0.5, self.offset + 9)) + 0.05 * noise.noise(
            (x * 1.6, y * 1.6, 3)
        )
        open_ground = smooth(0.7, 1.9, off)
        z = (
            rolling
            + bumps * (0.25 + 0.75 * open_ground)
            + 0.45 * smooth(1.4, 7.0, off)
            - 0.10 * (1 - open_ground)
        )
        if self.pond is not None:
            centre, radius = self.pond
            far = (Vector((x, y)) - centre).length / radius
            z += (-0.55 - z) * (1 - smooth(0.75, 1.5, far + 0.15 * noise.noise((x, y, 5))))
        return z


def plan(rng: random.Random, split: str, clip: int, frames: int, terrain: Terrain) -> Shot:
    """The camera's move: test clips start from another kind than train clips of the same number do."""
    kind = (
        SHOTS[(clip + (2 if split == "test" else 0)) % len(SHOTS)]
        if split == "test"
        else SHOTS[clip % len(SHOTS)]
    )
    side = rng.choice((-1, 1))
    step = frames + 1
    steps = range(5)
    if kind in ("walk", "back"):
        run = rng.uniform(0.10, 0.13) * step * (1 if kind == "walk" else -0.8)
        start = rng.uniform(-1.0, 1.0)
        bob = rng.uniform(0.02, 0.04)
        points, targets = [], []
        for i in steps:
            y = start + run * i / 4
            lift = bob * math.sin(2.2 * i)
            points.append((terrain.path_x(y) + side * 0.2 * math.sin(0.8 * i), y, 1.4 + lift))
            drift = side * (-1.1 + 2.2 * i / 4)
            targets.append((terrain.path_x(y + 7) * 0.8 + drift, y + 7, 1.55 + 0.5 * rng.uniform(0.4, 1.0)))
    elif kind == "dolly":
        run = rng.uniform(0.06, 0.085) * step * rng.choice((-1, 1))
        angle = rng.uniform(0.9, 1.25)
        points, targets = [], []
        for i in steps:
            y = run * (i / 4 - 0.5)
            x = terrain.path_x(y) - side * 1.5
            points.append((x, y, 1.25))
            targets.append((x + side * 7 * math.sin(angle), y * 0.85 + 7 * math.cos(angle), 1.45))
    elif kind == "low":
        run = rng.uniform(0.07, 0.09) * step
        points, targets = [], []
        for i in steps:
            t = i / 4
            x = terrain.path_x(0) + side * (0.7 - 0.5 * run * t)
            points.append((x, run * 0.75 * t, 0.55 + 0.35 * t))
            targets.append((x - side * (0.6 + 1.1 * t), run * t + 6.5, 1.0 + 0.7 * t))
    else:
        turn = side * rng.uniform(0.014, 0.019) * step
        middle = Vector((terrain.path_x(4.6), 4.6))
        points = [
            (middle.x + 4.6 * math.sin(a), middle.y - 4.6 * math.cos(a), 1.15 + 0.1 * i)
            for i, a in enumerate(turn * (i / 4 - 0.5) for i in steps)
        ]
        targets = [(middle.x, middle.y, 1.35)]
    ground = terrain.height
    points = [(x, y, ground(x, y) * 0.5 + z) for x, y, z in points]
    return Shot(kind, points, targets)


class Forest:
    """Places things around one shot; remembers where trunks stand."""

    def __init__(self, rng: random.Random, terrain: Terrain, shot: Shot, frames: int):
        self.rng, self.terrain, self.shot, self.frames = rng, terrain, shot, frames
        self.taken: list[tuple[Vector, float]] = []
        self.track = [common.curve_point(shot.points, i / 20) for i in range(21)]

    def at(self, x: float, y: float, sink: float = 0.0) -> Vector:
        """The point of the ground at x, y, lowered by `sink`."""
        return Vector((x, y, self.terrain.height(x, y) - sink))

    def off_camera(self, x: float, y: float) -> float:
        """Distance from the camera's track in the ground plane."""
        return min((Vector((x, y)) - point.xy).length for point in self.track)

    def in_view(self, x: float, y: float, half_angle: float = 0.72) -> bool:
        """Whether some camera position sees this direction (with a margin)."""
        heading = self.shot.heading
        back = self.shot.centre - 2.5 * Vector((math.cos(heading), math.sin(heading)))
        angle = math.atan2(y - back.y, x - back.x) - heading
        return abs((angle + math.pi) % math.tau - math.pi) < half_angle

    def free(self, x: float, y: float, radius: float) -> bool:
        """Whether nothing large stands within `radius`."""
        return all((Vector((x, y)) - centre).length > radius + other for centre, other in self.taken)

    def polar(self, near: float, far: float, half_angle: float = 0.75) -> tuple[float, float]:
        """A random point of the view's sector, denser near the camera."""
        rng = self.rng
        distance = near + (far - near) * rng.random() ** 0.9
        angle = self.shot.heading + rng.uniform(-half_angle, half_angle)
        return self.shot.centre.x + distance * math.cos(angle), self.shot.centre.y + distance * math.sin(
            angle
        )

    def sway(self, ob: bpy.types.Object, degrees: float, period: float) -> None:
        """Key a rigid rocking about the object's own origin; neighbours move alike, as in gusts."""
        rng, rest = self.rng, common.place(ob.location, ob.rotation_euler) @ Matrix.Diagonal((*ob.scale, 1))
        phase = 0.35 * (ob.location.x + ob.location.y) + rng.uniform(-0.8, 0.8)
        first, second = rng.uniform(0.8, 1.25) * math.tau / period, rng.uniform(1.7, 2.3) * math.tau / period
        size = math.radians(degrees)
        origin = Matrix.Translation(ob.location)

        def at(frame: int) -> Matrix:
            x = size * (math.sin(first * frame + phase) + 0.3 * math.sin(second * frame))
            y = size * 0.7 * math.sin(first * frame * 0.9 + phase + 1.1)
            turn = Matrix.Rotation(x, 4, "X") @ Matrix.Rotation(y, 4, "Y")
            return origin @ turn @ origin.inverted() @ rest

        common.key_motion(ob, self.frames, at)


def plant_trees(forest: Forest, sun_from: Vector, palette: random.Random) -> None:
    """Trunks in view and towards the sun, their swaying branches, and far foliage."""
    rng, terrain, shot = forest.rng, forest.terrain, forest.shot
    red = parts.bark_material("redwood bark", (0.040, 0.017, 0.011), (0.30, 0.135, 0.075), 0.26)
    grey = parts.bark_material("fir bark", (0.040, 0.033, 0.026), (0.27, 0.22, 0.165), 0.34, 1.2)
    needles = parts.leaf_material(
        "conifer", [(0.022, 0.060, 0.022), (0.045, 0.105, 0.026), (0.085, 0.155, 0.035), (0.15, 0.19, 0.045)]
    )
    trunks = [(parts.trunk(palette, red, r, h), r) for r, h in ((0.95, 30), (0.75, 27), (0.6, 26))]
    trunks += [(parts.trunk(palette, grey, r, h, 32, 34), r) for r, h in ((0.36, 22), (0.26, 20))]
    branches = [parts.branch(palette, needles, grey, length) for length in (4.4, 3.6, 2.8)]
    clumps = [parts.clump(palette, needles) for _ in range(3)]
    heading = shot.heading
    crowns: list[bpy.types.Object] = []

    spots: list[tuple[float, float, int, float]] = []
    left = rng.choice((-1, 1))
    for sign, distance, angle, kind in (
        (left, 6.3, 0.33, 0),
        (-left, 8.8, 0.36, 1),
        (left, 12.0, 0.13, 2),
        (-left, 6.0, 0.56, 3),
    ):
        for _ in range(30):  # composed trees: large ones on both sides of the view
            a = heading + sign * (angle + rng.uniform(-0.08, 0.08))
            d = distance * rng.uniform(0.85, 1.2)
            x, y = shot.centre.x + d * math.cos(a), shot.centre.y + d * math.sin(a)
            radius = trunks[kind][1]
            if (
                terrain.from_path(x, y) > 1.3 + radius
                and forest.off_camera(x, y) > 1.8 + radius
                and forest.free(x, y, radius + 1.6)
            ):
                spots.append((x, y, kind, rng.uniform(0.95, 1.1)))
                forest.taken.append((Vector((x, y)), radius * 1.2))
                break
    for _ in range(2600):
        if len(spots) > 95:
            break
        angle, distance = rng.uniform(0, math.tau), 46 * math.sqrt(rng.random())
        x, y = shot.centre.x + distance * math.cos(angle), shot.centre.y + distance * math.sin(angle)
        kind = rng.choice((0, 1, 1, 2, 2, 3, 3, 4, 4))
        scale = rng.uniform(0.8, 1.15)
        radius = trunks[kind][1] * scale
        toward_sun = (Vector((x, y)) - shot.centre).dot(sun_from.xy.normalized())
        useful = forest.in_view(x, y, 0.62) or (distance < 26 and toward_sun > -4) or distance < 9
        if not useful or terrain.from_path(x, y) < 1.5 + radius or forest.off_camera(x, y) < 2.6 + radius:
            continue
        if forest.in_view(x, y, 0.5) and distance < 6.5:
            continue
        if forest.free(x, y, radius + (1.7 if kind < 3 else 1.1)):
            spots.append((x, y, kind, scale))
            forest.taken.append((Vector((x, y)), radius * 1.2))

    for x, y, kind, scale in spots:
        data, radius = trunks[kind]
        foot = forest.at(x, y, 0.1)
        tilt = (rng.gauss(0, 0.02), rng.gauss(0, 0.02), rng.uniform(0, math.tau))
        common.add(data, location=foot, rotation=tilt, scale=scale)
        distance = (Vector((x, y)) - shot.centre).length
        low = 4.2 if kind >= 3 else 6.5
        for _ in range(11 if distance < 24 else 8):
            z, angle = rng.uniform(low, 19.0), rng.uniform(0, math.tau)
            reach = radius * scale * 0.5
            where = foot + Vector((math.cos(angle) * reach, math.sin(angle) * reach, z))
            size = rng.uniform(0.75, 1.15) * (1.15 - 0.02 * z)
            ob = common.add(
                rng.choice(branches),
                location=where,
                rotation=(rng.uniform(-0.15, 0.25), 0, angle - math.pi / 2),
                scale=size,
            )
            crowns.append(ob)
            if distance < 24:
                forest.sway(ob, rng.uniform(1.2, 2.4), 30)
    open_canopy(forest, crowns, sun_from)
    for _ in range(64):  # the wall of leaves behind everything
        x, y = forest.polar(24, 46, 0.68)
        if terrain.from_path(x, y) > 2.5:
            where = forest.at(x, y) + Vector((0, 0, rng.uniform(0.5, 5.5)))
            common.add(
                rng.choice(clumps),
                location=where,
                rotation=(0, 0, rng.uniform(0, 6)),
                scale=rng.uniform(0.7, 1.3),
            )


def open_canopy(forest: Forest, crowns: list[bpy.types.Object], sun_from: Vector) -> None:
    """Take away branches between the sun and some pools of light on the ground in view."""
    bpy.context.view_layer.update()
    graph, scene = bpy.context.evaluated_depsgraph_get(), bpy.context.scene
    names = {ob.name for ob in crowns}
    blocking: set[str] = set()
    for _ in range(200):
        x, y = forest.polar(1.5, 17, 0.6)
        if noise.noise((x * 0.30, y * 0.30, forest.terrain.offset + 50)) < -0.12:
            continue
        start, hits = forest.at(x, y) + Vector((0, 0, 0.3)), set()
        for _ in range(40):
            found, where, _, _, ob, _ = scene.ray_cast(graph, start, sun_from)
            if not found:
                blocking |= hits
                break
            if ob.name not in names:
                break  # a trunk: this point stays in shade
            hits.add(ob.name)
            start = where + sun_from * 0.02
    for name in sorted(blocking):
        bpy.data.objects.remove(bpy.data.objects[name])


def plant_undergrowth(forest: Forest, palette: random.Random) -> None:
    """Ferns, maples, grass, sorrel, litter, rocks and logs."""
    rng, terrain, shot = forest.rng, forest.terrain, forest.shot
    stem = parts.leaf_material("stem", [(0.05, 0.035, 0.018), (0.10, 0.08, 0.03)], 0.7)
    frond = parts.leaf_material(
        "fern", [(0.040, 0.105, 0.020), (0.080, 0.185, 0.028), (0.150, 0.260, 0.040), (0.26, 0.30, 0.06)]
    )
    maple = parts.leaf_material(
        "maple", [(0.075, 0.20, 0.030), (0.16, 0.30, 0.040), (0.32, 0.38, 0.050), (0.50, 0.33, 0.040)]
    )
    blade = parts.leaf_material("grass", [(0.07, 0.14, 0.025), (0.16, 0.25, 0.045), (0.30, 0.31, 0.09)], 0.55)
    clover = parts.leaf_material(
        "sorrel", [(0.05, 0.15, 0.028), (0.10, 0.24, 0.040), (0.17, 0.33, 0.06)], 0.6
    )
    dead = parts.leaf_material(
        "litter", [(0.11, 0.05, 0.018), (0.27, 0.12, 0.03), (0.42, 0.22, 0.05), (0.50, 0.34, 0.10)], 0.7
    )
    stone = parts.rock_material()
    near_ferns = [parts.fern(palette, frond, stem) for _ in range(3)]
    far_ferns = [parts.fern(palette, frond, stem, 9, 6) for _ in range(2)]
    bushes = [parts.bush(palette, maple, stem), parts.bush(palette, maple, stem, 2.6, 4, 0.16, 26)]
    tufts = [parts.grass(palette, blade) for _ in range(3)]
    covers = [parts.sorrel(palette, clover, stem) for _ in range(3)]
    drifts = [parts.litter(palette, dead) for _ in range(3)]
    rocks = [parts.rock(palette, stone) for _ in range(4)]
    bark = parts.bark_material("log bark", (0.035, 0.022, 0.014), (0.24, 0.15, 0.09), 0.22)
    wood = parts.leaf_material("cut wood", [(0.42, 0.24, 0.11), (0.50, 0.30, 0.15)], 0.8)
    fungus = parts.leaf_material("fungus", [(0.62, 0.30, 0.07), (0.80, 0.60, 0.32)], 0.6)
    fallen = parts.log(palette, bark, wood, fungus)

    def spin() -> tuple[float, float, float]:
        return (rng.gauss(0, 0.08), rng.gauss(0, 0.08), rng.uniform(0, math.tau))

    logs = 0
    for _ in range(200):  # one log in the middle distance, one or two farther off
        x, y = forest.polar(4.2, 7.0, 0.42) if logs == 0 else forest.polar(8, 18, 0.5)
        turn = shot.heading + math.pi / 2 + rng.uniform(-0.7, 0.7)
        along = Vector((math.cos(turn), math.sin(turn)))
        spots = [Vector((x, y)) + along * s for s in (-3, -1.5, 0, 1.5, 3)]
        if all(
            forest.off_camera(*s) > 2.2 and terrain.from_path(*s) > 1.2 and forest.free(*s, 0.5)
            for s in spots
        ):
            low, high = (terrain.height(*s) for s in (spots[0], spots[-1]))
            tilt = -math.atan2(high - low, 6.0)
            where = Vector((x, y, (low + high) / 2 - 0.06))
            common.add(fallen, location=where, rotation=(0, tilt, turn), scale=rng.uniform(0.8, 1.1))
            forest.taken += [(s, 0.45) for s in spots]
            logs += 1
            if logs == 3:
                break

    def strew(
        count,
        kinds,
        near,
        far,
        path,
        camera,
        size,
        sink,
        spacing=0.0,
        cluster=-1.0,
        angle=0.75,
        sway=None,
        spread=9.0,
    ):
        """Scatter `count` objects of `kinds` in the sector, off the path, the camera's track and trunks."""
        for _ in range(count):
            x, y = forest.polar(near, far, angle)
            scale = rng.uniform(*size)
            if (
                terrain.from_path(x, y) < path
                or forest.off_camera(x, y) < camera
                or not forest.free(x, y, spacing)
            ):
                continue
            if terrain.pond and (Vector((x, y)) - terrain.pond[0]).length < terrain.pond[1] * 1.15:
                continue
            if noise.noise((x * 0.28, y * 0.28, terrain.offset + cluster)) < cluster:
                continue
            ob = common.add(
                rng.choice(kinds), location=forest.at(x, y, sink * scale), rotation=spin(), scale=scale
            )
            if sway and (Vector((x, y)) - shot.centre).length < spread:
                forest.sway(ob, *sway)

    strew(26, rocks, 2.0, 14, 0.9, 1.3, (0.16, 0.6), 0.25, 0.2)
    strew(14, rocks, 2.2, 12, 0.55, 0.8, (0.08, 0.18), 0.2)
    strew(150, near_ferns, 1.6, 10, 1.0, 1.15, (0.7, 1.2), 0.04, 0.15, -0.22, 0.9, (2.6, 26))
    strew(330, far_ferns, 10, 30, 1.0, 3.0, (0.8, 1.5), 0.04, 0.1, -0.18)
    strew(34, bushes, 3.4, 20, 1.5, 2.6, (0.7, 1.15), 0.02, 0.3, -0.1, 0.7, (1.8, 30), 14.0)
    strew(420, tufts, 1.2, 9, 0.65, 0.7, (0.6, 1.2), 0.02, 0.0, -0.1, 0.85, (3.5, 22), 5.0)
    strew(260, covers, 1.2, 9, 0.85, 0.6, (0.7, 1.1), 0.0, 0.0, -0.05, 0.85)
    strew(240, drifts, 1.0, 12, 0.0, 0.0, (0.8, 1.3), 0.0, 0.0, -0.4, 0.85)


def add_ground(forest: Forest) -> None:
    """The terrain mesh, finer near the camera, darkened around trunks, and the pond."""
    terrain, shot = forest.terrain, forest.shot
    tree = kdtree.KDTree(len(forest.taken))
    for index, (centre, _) in enumerate(forest.taken):
        tree.insert((*centre, 0), index)
    tree.balance()
    cells = 150
    steps = [0.5 * math.sinh(4.9 * (2 * i / cells - 1)) / math.sinh(4.9) * 2 for i in range(cells + 1)]
    steps = [55 * (0.16 * (2 * i / cells - 1) + 0.84 * value) for i, value in enumerate(steps)]
    made = parts.Builder()
    tints, depth = [], []
    for v in steps:
        for u in steps:
            x, y = shot.centre.x + u, shot.centre.y + v
            made.vertices.append(forest.at(x, y))
            tints.append(1 - smooth(0.55, 1.25, terrain.from_path(x, y)))
            _, index, far = tree.find((x, y, 0))
            near = (far - forest.taken[index][1]) / 1.2
            depth.append(0.32 + 0.68 * smooth(-0.1, 1.0, near))
    made.shades = [(tint, value, 0.0, 1.0) for tint, value in zip(tints, depth, strict=True)]
    row = cells + 1
    made.faces = [
        (j * row + i, j * row + i + 1, (j + 1) * row + i + 1, (j + 1) * row + i)
        for j in range(cells)
        for i in range(cells)
    ]
    made.slots, made.smooth = [0] * len(made.faces), [True] * len(made.faces)
    common.add(made.mesh("ground", [parts.ground_material()]))
    if terrain.pond is not None:
        centre, radius = terrain.pond
        water = common.material("water", (0.012, 0.020, 0.016), roughness=0.03)
        rim = [
            (radius * 1.6 * math.cos(a), radius * 1.6 * math.sin(a), 0)
            for a in (math.tau * i / 48 for i in range(48))
        ]
        common.add(common.mesh("water", rim, [range(48)], water), location=(*centre, -0.22))


def add_lanterns(forest: Forest, palette: random.Random) -> None:
    """Two posts beside the path with lanterns that swing about their hooks."""
    rng, terrain, frames = forest.rng, forest.terrain, forest.frames
    wood = parts.plain_material("post wood", (0.16, 0.10, 0.06), 0.8)
    paper = parts.plain_material("paper", (0.5, 0.3, 0.12), 0.8, glow=(1.9, 0.85, 0.22))
    frame = parts.plain_material("lantern frame", (0.05, 0.035, 0.03), 0.4)
    post, lamp = parts.post(wood), parts.lantern(paper, frame)
    placed = 0
    for _ in range(300):
        x, y = forest.polar(3.6, 5.2, 0.34) if placed == 0 else forest.polar(7.0, 12.0, 0.4)
        if (
            not 0.95 < terrain.from_path(x, y) < (3.0 if placed == 0 else 2.0)
            or forest.off_camera(x, y) < 1.6
        ):
            continue
        if not forest.free(x, y, 0.25):
            continue
        turn = math.atan2(0.0, terrain.path_x(y) - x) + rng.uniform(-0.5, 0.5)
        foot = forest.at(x, y)
        common.add(post, location=foot, rotation=(0, 0, turn))
        hook = foot + Vector((0.8 * math.cos(turn), 0.8 * math.sin(turn), 2.5))
        ob = common.add(lamp)
        pace, phase = rng.uniform(0.24, 0.32), rng.uniform(0, math.tau)

        def swing(f: int, hook=hook, pace=pace, phase=phase) -> Matrix:
            tilt = (0.20 * math.sin(pace * f + phase), 0.13 * math.sin(pace * f + phase + 1.0), 0.02 * f)
            return common.place(hook, tilt)

        common.key_motion(ob, frames, swing)
        forest.taken.append((Vector((x, y)), 0.2))
        placed += 1
        if placed == 2:
            break


def add_flyers(forest: Forest, palette: random.Random) -> None:
    """Drifting leaves, birds that cross the view, butterflies over the path."""
    rng, shot, frames = forest.rng, forest.shot, forest.frames
    heading = shot.heading
    ahead, right = (
        Vector((math.cos(heading), math.sin(heading), 0)),
        Vector((math.sin(heading), -math.cos(heading), 0)),
    )
    middle = common.curve_point(shot.points, 0.5)
    autumn = parts.leaf_material("autumn", [(0.45, 0.10, 0.02), (0.65, 0.27, 0.03), (0.70, 0.46, 0.06)])
    leaves = [parts.single_leaf(palette, autumn, size) for size in (0.13, 0.17)]
    for _ in range(26):
        far = rng.uniform(2.6, 9.0)
        start = (
            middle
            + ahead * far
            + right * (far * rng.uniform(-0.75, 0.75))
            + Vector((0, 0, rng.uniform(-0.8, 2.2) * far / 5))
        )
        drift = (
            right * rng.uniform(-0.02, 0.05)
            + ahead * rng.uniform(-0.02, 0.02)
            + Vector((0, 0, -rng.uniform(0.012, 0.032)))
        )
        spin = Vector([rng.uniform(-0.16, 0.16) for _ in range(3)])
        phase, first = rng.uniform(0, math.tau), [rng.uniform(0, math.tau) for _ in range(3)]

        def fall(f: int, start=start, drift=drift, spin=spin, phase=phase, first=first) -> Matrix:
            f -= frames / 2
            where = start + drift * f + right * (0.10 * math.sin(0.22 * f + phase))
            return common.place(where, [a + b * f for a, b in zip(first, spin, strict=True)])

        common.key_motion(common.add(rng.choice(leaves)), frames, fall)

    feather = parts.leaf_material(
        "jay", [(0.05, 0.14, 0.42), (0.10, 0.26, 0.62), (0.45, 0.55, 0.65), (0.03, 0.04, 0.07)], 0.5
    )
    beak = parts.plain_material("beak", (0.5, 0.3, 0.06))
    orange = parts.leaf_material("orange wings", [(0.75, 0.24, 0.02), (0.85, 0.42, 0.05), (0.06, 0.03, 0.02)])
    blue = parts.leaf_material("blue wings", [(0.12, 0.30, 0.75), (0.35, 0.55, 0.9), (0.05, 0.06, 0.12)])
    body = parts.bird_body(feather, beak)
    flyers = [
        (body, parts.wing(feather, 0.42, 0.20, 0.25, "bird wing"), 0.85, 0.42, "bird") for _ in range(2)
    ]
    shape = common.tube_mesh(
        "insect", [(0, -0.06, 0), (0, 0, 0), (0, 0.06, 0)], [0.008, 0.014, 0.008], beak, 6
    )
    wings = [parts.wing(mat, 0.10, 0.13, -0.15, "butterfly wing") for mat in (orange, blue)]
    flyers += [(shape, wings[i % 2], 1.0, 0.75, "butterfly") for i in range(4)]
    for data, wing, spread, pace, kind in flyers:
        bird = kind == "bird"
        far = rng.uniform(5.0, 8.5) if bird else rng.uniform(2.4, 4.6)
        sign = rng.choice((-1, 1))
        speed = sign * (rng.uniform(0.10, 0.17) if bird else rng.uniform(0.015, 0.035))
        level = rng.uniform(0.1, 0.30) if bird else rng.uniform(-0.16, 0.12)
        where = middle + ahead * far + right * (far * rng.uniform(-0.45, 0.45)) + Vector((0, 0, far * level))
        course = right * speed + ahead * rng.uniform(-0.04, 0.04)
        yaw = math.atan2(course.y, course.x) - math.pi / 2
        phase = rng.uniform(0, math.tau)
        holder = common.add(data, kind)

        def fly(f: int, where=where, course=course, yaw=yaw, phase=phase, pace=pace, bird=bird) -> Matrix:
            lift = (0.03 if bird else 0.07) * math.sin((pace if bird else 0.31) * f + phase)
            weave = 0.0 if bird else 0.5 * math.sin(0.2 * f + phase)
            aside = Vector((0, 0, lift)) + ahead * (0.0 if bird else 0.08 * math.sin(0.2 * f + phase))
            pitch = 0.05 if bird else 0.75  # butterflies hang so that their wings are seen from the side
            turn = (pitch + 0.05 * math.sin(0.3 * f), 0.1 * math.sin(0.2 * f), yaw + weave)
            return common.place(where + course * (f - frames / 2) + aside, turn)

        common.key_motion(holder, frames, fly)
        for side in (-1, 1):
            ob = common.add(wing, parent=holder)

            def flap(f: int, side=side, phase=phase, pace=pace, spread=spread, bird=bird) -> Matrix:
                angle = 0.15 + spread * math.sin(pace * f + phase)
                root = Vector((side * 0.02, 0.03, 0.03 if bird else 0.01))
                return (
                    Matrix.Translation(root)
                    @ Matrix.Rotation(-side * angle, 4, "Y")
                    @ Matrix.Diagonal((side, 1, 1, 1))
                )

            rest = [flap(f) for f in range(frames + 2)]
            key_mirrored(ob, rest, side)


def key_mirrored(ob: bpy.types.Object, matrices: list[Matrix], side: int) -> None:
    """Key a wing; a mirrored one is keyed by its rotation alone (a mirror does not survive decomposition)."""
    mirror = Matrix.Diagonal((side, 1, 1, 1))
    common.key_matrices(ob, [matrix @ mirror for matrix in matrices])
    ob.scale = (side, 1, 1)


def build(*, seed: int, split: str, clip: int, frames: int) -> None:
    """Build the scene into an emptied Blender file."""
    rng = common.generator("forest", seed, split, clip)
    palette = common.generator("forest meshes", seed, split, clip)
    terrain = Terrain(rng)
    shot = plan(rng, split, clip, frames, terrain)
    if rng.random() < 0.5 or shot.kind == "orbit":
        for _ in range(60):
            distance, angle = rng.uniform(5.0, 7.5), shot.heading + rng.uniform(-0.5, 0.5)
            spot = shot.centre + distance * Vector((math.cos(angle), math.sin(angle)))
            if terrain.from_path(*spot) > 3.2:
                terrain.pond = (spot, rng.uniform(1.5, 2.0))
                break

    camera = common.camera(FOV_DEG, near=0.05, far=300.0)
    common.look_at_path(camera, shot.points, shot.targets, frames)

    forest = Forest(rng, terrain, shot, frames)
    if terrain.pond is not None:
        forest.taken.append((terrain.pond[0], terrain.pond[1] * 1.2))
    side = rng.choice((-1, 1))
    azimuth = shot.heading + side * math.radians(rng.uniform(85, 125))
    elevation = math.radians(rng.uniform(40, 50))
    sun_from = Vector(
        (
            math.cos(azimuth) * math.cos(elevation),
            math.sin(azimuth) * math.cos(elevation),
            math.sin(elevation),
        )
    )
    common.sun(-sun_from, (1.0, 0.80, 0.54), 7.0, 0.12)
    common.sky(
        [
            (-1.0, parts.HAZE),
            (0.0, (0.80, 0.86, 0.80)),
            (0.25, (0.62, 0.76, 0.85)),
            (0.7, (0.30, 0.50, 0.80)),
        ],
        light=(0.05, 0.065, 0.08),
    )
    # Diffuse rays find the dim world by chance; every light sample goes to the sun.
    bpy.context.scene.world.cycles.sampling_method = "NONE"
    add_lanterns(forest, palette)
    plant_trees(forest, sun_from, palette)
    plant_undergrowth(forest, palette)
    if terrain.pond is not None:
        forest.taken = [(c, r) for c, r in forest.taken if (c - terrain.pond[0]).length > 0.01]
    add_ground(forest)
    add_flyers(forest, palette)
