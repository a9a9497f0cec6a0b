"""Meshes and materials of the forest scene: bark, leaves, ferns, branches, rocks, birds, lanterns.

Leaves are real geometry (no alpha). Every mesh carries a point attribute "shade": red varies the tint from
leaf to leaf, green is the ambient occlusion that its author knows (0 in the heart of a plant, 1 at the tips).
Sun light is Cycles'; most of the sky light is a noise-free hemisphere term in the emission input,
and so is the haze that grows with view distance, so few samples give a clean truth.
"""

import math
import sys
from pathlib import Path

import bpy
from mathutils import Matrix, Vector, noise

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common

HAZE = (0.44, 0.52, 0.51)
SKY_LIGHT = (0.30, 0.40, 0.48)
GROUND_LIGHT = (0.13, 0.12, 0.06)


# --- materials ------------------------------------------------------------------------------------------


def lit(nodes: common.Nodes, base: object, occlusion: object, normal: object = None) -> None:
    """Connect base colour and the ambient light: base * hemisphere(normal) * occlusion, faded into haze."""
    tree_normal = normal if normal is not None else nodes.node("ShaderNodeNewGeometry").outputs["Normal"]
    up = nodes.node("ShaderNodeSeparateXYZ", {0: tree_normal}).outputs["Z"]
    ambient = nodes.mix(nodes.step(up, -1.0, 1.0), GROUND_LIGHT, SKY_LIGHT)
    ambient = nodes.mix(1.0, ambient, occlusion, "MULTIPLY")
    distance = nodes.node("ShaderNodeCameraData").outputs["View Distance"]
    beyond = nodes.math("MAXIMUM", nodes.math("SUBTRACT", distance, 9.0), 0.0)
    haze = nodes.math("SUBTRACT", 1.0, nodes.math("EXPONENT", nodes.math("MULTIPLY", beyond, -1 / 58)))
    haze = nodes.math("MINIMUM", haze, 0.66)
    nodes.set("Base Color", nodes.mix(haze, base, (0.02, 0.02, 0.02)))
    nodes.set("Emission Color", nodes.mix(haze, nodes.mix(1.0, base, ambient, "MULTIPLY"), HAZE))
    nodes.set("Emission Strength", 1.0)


def surface(name: str, roughness: float, specular: float = 0.3) -> tuple[bpy.types.Material, common.Nodes]:
    """A material whose emission lights nothing (it is ambient light, not a lamp)."""
    mat = common.material(name, roughness=roughness, specular=specular)
    mat.cycles.emission_sampling = "NONE"
    return mat, common.Nodes(mat)


def shade(nodes: common.Nodes) -> tuple[bpy.types.NodeSocket, bpy.types.NodeSocket]:
    """The attribute "shade" as (tint, occlusion)."""
    color = nodes.node("ShaderNodeAttribute", attribute_name="shade").outputs["Color"]
    split = nodes.node("ShaderNodeSeparateColor", {0: color})
    return split.outputs[0], split.outputs[1]


def leaf_material(name: str, colors: list[common.Color], roughness: float = 0.5) -> bpy.types.Material:
    """Leaves whose colour runs through `colors` by leaf and by plant."""
    mat, nodes = surface(name, roughness, 0.4)
    tint, occlusion = shade(nodes)
    mixed = nodes.math(
        "ADD", nodes.math("MULTIPLY", tint, 0.6), nodes.math("MULTIPLY", nodes.object_random(), 0.4)
    )
    stops = [(index / (len(colors) - 1), color) for index, color in enumerate(colors)]
    lit(nodes, nodes.ramp(mixed, stops), occlusion)
    return mat


def bark_material(name: str, dark: common.Color, light: common.Color, moss: float, grain: float = 1.0):
    """Bark with long vertical cracks (the mesh's own z), moss low down and on upward faces."""
    mat, nodes = surface(name, 0.9, 0.2)
    tint, occlusion = shade(nodes)
    place = nodes.coordinates()
    cracks = nodes.noise(nodes.mapping(place, (1, 1, 0.13)), 7.0 * grain, 2.0, 0.55)
    patches = nodes.noise(place, 1.1, 2.0)
    base = nodes.ramp(
        cracks,
        [(0.34, dark), (0.5, tuple((a + b) / 2 for a, b in zip(dark, light, strict=True))), (0.68, light)],
    )
    grey = nodes.step(patches, 0.5, 0.68, 0.0, 0.6)
    base = nodes.mix(grey, base, nodes.mix(0.5, base, (0.20, 0.18, 0.15)))
    base = nodes.mix(nodes.math("MULTIPLY", nodes.object_random(), 0.45), base, (0.20, 0.085, 0.04))
    green = nodes.ramp(nodes.noise(place, 9.0, 2.0), [(0.3, (0.035, 0.06, 0.010)), (0.7, (0.13, 0.19, 0.03))])
    up = nodes.node(
        "ShaderNodeSeparateXYZ", {0: nodes.node("ShaderNodeNewGeometry").outputs["Normal"]}
    ).outputs["Z"]
    grown = nodes.math(
        "ADD", nodes.math("ADD", patches, nodes.math("MULTIPLY", up, 0.35)), nodes.math("MULTIPLY", tint, 0.5)
    )
    base = nodes.mix(nodes.step(grown, 1.0 - moss, 1.14 - moss), base, green)
    nodes.set("Normal", nodes.bump(cracks, 0.12, 0.9))
    lit(nodes, base, occlusion)
    return mat


def rock_material() -> bpy.types.Material:
    """Grey stone with lichen, mossy on top."""
    mat, nodes = surface("rock", 0.8)
    _, occlusion = shade(nodes)
    place = nodes.coordinates()
    rough = nodes.noise(place, 3.0, 3.0, 0.6)
    base = nodes.ramp(
        rough, [(0.3, (0.05, 0.05, 0.05)), (0.55, (0.19, 0.18, 0.165)), (0.7, (0.34, 0.33, 0.30))]
    )
    cells = nodes.voronoi(place, 4.0)
    base = nodes.mix(nodes.step(cells, 0.16, 0.10, 0.0, 0.8), base, (0.36, 0.34, 0.20))
    up = nodes.node(
        "ShaderNodeSeparateXYZ", {0: nodes.node("ShaderNodeNewGeometry").outputs["Normal"]}
    ).outputs["Z"]
    moss = nodes.step(nodes.math("ADD", up, rough), 0.80, 1.10)
    green = nodes.ramp(
        nodes.noise(place, 12.0, 1.0), [(0.35, (0.04, 0.065, 0.012)), (0.65, (0.15, 0.21, 0.03))]
    )
    nodes.set("Normal", nodes.bump(rough, 0.15, 0.8))
    lit(nodes, nodes.mix(moss, base, green), occlusion)
    return mat


def ground_material() -> bpy.types.Material:
    """Forest floor: litter and moss; "shade" red is 1 on the trodden path, green the occlusion."""
    mat, nodes = surface("ground", 0.9, 0.2)
    path, occlusion = shade(nodes)
    place = nodes.world_position()
    litter = nodes.voronoi(place, 6.0, output="Color")
    litter = nodes.node("ShaderNodeSeparateColor", {0: litter}).outputs[0]
    base = nodes.ramp(
        litter, [(0.0, (0.045, 0.022, 0.010)), (0.5, (0.115, 0.055, 0.022)), (1.0, (0.23, 0.125, 0.045))]
    )
    soil = nodes.noise(place, 2.2, 3.0, 0.6)
    earth = nodes.ramp(
        soil, [(0.3, (0.10, 0.058, 0.032)), (0.5, (0.19, 0.115, 0.065)), (0.7, (0.30, 0.20, 0.12))]
    )
    earth = nodes.mix(nodes.step(nodes.voronoi(place, 3.4), 0.20, 0.14, 0.0, 0.75), earth, (0.27, 0.25, 0.22))
    wide = nodes.noise(place, 0.55, 2.0)
    moss = nodes.ramp(
        nodes.noise(place, 7.0, 1.0), [(0.35, (0.035, 0.06, 0.012)), (0.65, (0.12, 0.18, 0.03))]
    )
    base = nodes.mix(nodes.step(wide, 0.46, 0.60), base, moss)
    edge = nodes.math("ADD", path, nodes.math("MULTIPLY", nodes.math("SUBTRACT", soil, 0.5), 0.9))
    base = nodes.mix(nodes.step(edge, 0.35, 0.65), base, earth)
    nodes.set("Normal", nodes.bump(nodes.math("ADD", soil, nodes.math("MULTIPLY", litter, 0.15)), 0.18, 0.8))
    lit(nodes, base, occlusion)
    return mat


def plain_material(name: str, color: common.Color, roughness: float = 0.6, glow: common.Color | None = None):
    """One colour; `glow` adds emitted light of its own."""
    mat, nodes = surface(name, roughness, 0.5)
    if glow is not None:
        nodes.set("Base Color", color)
        nodes.set("Emission Color", glow)
        # A diffuse ray that hits the small lamp by chance would be a firefly: only eye and water see it.
        rays = nodes.node("ShaderNodeLightPath").outputs
        nodes.set("Emission Strength", nodes.math("MAXIMUM", rays["Is Camera Ray"], rays["Is Glossy Ray"]))
        return mat
    lit(nodes, color, (1.0, 1.0, 1.0))
    return mat


# --- mesh building --------------------------------------------------------------------------------------


class Builder:
    """Collects faces of several materials with the attribute "shade", then makes one mesh."""

    def __init__(self) -> None:
        self.vertices: list[Vector] = []
        self.faces: list[tuple[int, ...]] = []
        self.shades: list[tuple[float, float, float, float]] = []
        self.slots: list[int] = []
        self.smooth: list[bool] = []

    def add(self, vertices, faces, tint=0.5, occlusion=1.0, slot=0, smooth=False) -> None:
        """Append faces; `occlusion` is a number or one per vertex."""
        first = len(self.vertices)
        self.vertices += vertices
        many = occlusion if isinstance(occlusion, list) else [occlusion] * len(vertices)
        self.shades += [(tint, value, 0.0, 1.0) for value in many]
        self.faces += [tuple(first + index for index in face) for face in faces]
        self.slots += [slot] * len(faces)
        self.smooth += [smooth] * len(faces)

    def leaf(
        self, at: Matrix, length: float, width: float, tint: float, occlusion: float, droop=0.15, slot=0
    ):
        """A leaf along +y of `at`, folded at its midrib and drooping: six triangles."""
        half, fold = width / 2, width * 0.16
        points = [
            (0, 0, 0),
            (half, length * 0.32, fold),
            (0, length * 0.38, 0),
            (-half, length * 0.32, fold),
            (half * 0.72, length * 0.68, fold - droop * length * 0.4),
            (-half * 0.72, length * 0.68, fold - droop * length * 0.4),
            (0, length, -droop * length),
        ]
        faces = [(0, 1, 2), (0, 2, 3), (1, 4, 6, 2), (3, 2, 6, 5)]
        self.add([at @ Vector(point) for point in points], faces, tint, occlusion, slot)

    def tube(self, points, radii, sides=6, tint=0.0, occlusion=1.0, slot=0) -> None:
        """A thin smooth tube without caps."""
        vertices, faces = [], []
        for number, point in enumerate(points):
            ahead = Vector(points[min(number + 1, len(points) - 1)]) - Vector(points[max(number - 1, 0)])
            turn = ahead.to_track_quat("Z", "Y")
            for side in range(sides):
                angle = math.tau * side / sides
                ring = Vector((math.cos(angle), math.sin(angle), 0)) * radii[number]
                vertices.append(Vector(point) + turn @ ring)
        for ring in range(len(points) - 1):
            for side in range(sides):
                a, b = ring * sides + side, ring * sides + (side + 1) % sides
                faces.append((a, b, b + sides, a + sides))
        self.add(vertices, faces, tint, occlusion, slot, smooth=True)

    def mesh(self, name: str, materials: list[bpy.types.Material]) -> bpy.types.Mesh:
        """The finished mesh."""
        data = common.mesh(name, self.vertices, self.faces, materials, material_of_face=self.slots)
        data.polygons.foreach_set("use_smooth", self.smooth)
        attribute = data.color_attributes.new("shade", "FLOAT_COLOR", "POINT")
        attribute.data.foreach_set("color", [value for color in self.shades for value in color])
        return data


def aim(location, forward, up=(0, 0, 1)) -> Matrix:
    """Matrix whose +y points along `forward` and whose +z leans towards `up`."""
    turn = Vector(forward).to_track_quat("Y", "Z").to_matrix()
    if abs(Vector(forward).normalized().dot(Vector(up))) > 0.999:
        turn = Vector(forward).to_track_quat("Y", "X").to_matrix()
    return Matrix.Translation(Vector(location)) @ turn.to_4x4()


# --- plants ---------------------------------------------------------------------------------------------


def fern(rng, mat, stem, fronds=11, pairs=13, reach=0.85) -> bpy.types.Mesh:
    """Sword fern about one metre across: arching fronds with two rows of leaflets."""
    made = Builder()
    for number in range(fronds):
        turn = math.tau * (number + rng.uniform(-0.3, 0.3)) / fronds
        length, lift = reach * rng.uniform(0.75, 1.15), rng.uniform(0.75, 1.25)
        out = Vector((math.cos(turn), math.sin(turn), 0))
        side = Vector((-out.y, out.x, 0))
        spine = []
        for step in range(pairs + 1):
            t = step / pairs
            rise = length * lift * (1.15 * t - 0.95 * t * t)
            spine.append(out * (length * (0.18 * t + 0.82 * t**1.4)) + Vector((0, 0, rise)))
        made.tube(
            [*spine[::3], spine[-1]],
            [0.011 * (1 - 0.8 * i / (pairs // 3 + 1)) for i in range(len(spine[::3]) + 1)],
            4,
            0.2,
            0.6,
            1,
        )
        tint = rng.random()
        for step in range(2, pairs + 1):
            t = step / pairs
            along = (spine[step] - spine[step - 1]).normalized()
            size = length * 0.30 * math.sin(math.pi * (0.10 + 0.88 * t)) ** 0.8
            for sign in (-1, 1):
                forward = side * sign + along * 0.35 + Vector((0, 0, -0.18))
                at = aim(spine[step], forward)
                width = length / pairs * 1.05
                made.leaf(at, size, width, 0.75 * tint + 0.25 * rng.random(), 0.35 + 0.65 * t**0.6, 0.22)
    return made.mesh("fern", [mat, stem])


def grass(rng, mat, blades=16, height=0.38) -> bpy.types.Mesh:
    """A tuft of broad bent blades."""
    made = Builder()
    for _ in range(blades):
        turn, lean = rng.uniform(0, math.tau), rng.uniform(0.25, 0.9)
        out = Vector((math.cos(turn), math.sin(turn), 0))
        side = Vector((-out.y, out.x, 0))
        foot = out * rng.uniform(0, 0.08)
        tall, width = height * rng.uniform(0.6, 1.2), rng.uniform(0.016, 0.026)
        vertices, depth = [], []
        for step in range(4):
            t = step / 3
            centre = foot + out * (lean * tall * t * t) + Vector((0, 0, tall * (t - 0.25 * lean * t * t)))
            half = side * (width / 2 * (1 - t) ** 0.6)
            vertices += [centre - half, centre + half] if step < 3 else [centre]
            depth += [0.3 + 0.7 * t] * (2 if step < 3 else 1)
        made.add(vertices, [(0, 1, 3, 2), (2, 3, 5, 4), (4, 5, 6)], rng.random(), depth)
    return made.mesh("grass", [mat])


def sorrel(rng, mat, stem, plants=26, spread=0.45) -> bpy.types.Mesh:
    """Ground cover: three broad leaflets on each short stalk."""
    made = Builder()
    for _ in range(plants):
        turn, far = rng.uniform(0, math.tau), spread * math.sqrt(rng.random())
        foot = Vector((far * math.cos(turn), far * math.sin(turn), -0.02))
        top = foot + Vector((rng.uniform(-0.03, 0.03), rng.uniform(-0.03, 0.03), rng.uniform(0.08, 0.18)))
        made.tube([foot, top], [0.006, 0.004], 3, 0.2, 0.4, 1)
        tint, first, size = rng.random(), rng.uniform(0, math.tau), rng.uniform(0.07, 0.10)
        for leaflet in range(3):
            angle = first + math.tau * leaflet / 3
            at = aim(top, (math.cos(angle), math.sin(angle), 0.12))
            made.leaf(at, size, size * 0.95, tint, rng.uniform(0.75, 1.0), 0.3)
    return made.mesh("sorrel", [mat, stem])


def bush(rng, mat, stem, height=1.8, stems=5, leaf=0.14, leaves=22) -> bpy.types.Mesh:
    """Understory maple: thin bent stems with broad horizontal leaves."""
    made = Builder()
    for number in range(stems):
        turn = math.tau * (number + rng.uniform(-0.3, 0.3)) / stems
        tall, out = height * rng.uniform(0.65, 1.1), rng.uniform(0.35, 0.7)
        drift = Vector((math.cos(turn), math.sin(turn), 0)) * (out * height * 0.6)
        points = [drift * t**1.6 + Vector((0, 0, tall * t)) for t in (0, 0.2, 0.4, 0.6, 0.8, 1.0)]
        made.tube(points, [0.022, 0.019, 0.016, 0.013, 0.010, 0.006], 5, 0.1, 0.6, 1)
        for _ in range(leaves):
            t = rng.uniform(0.3, 1.0)
            root = common.curve_point(points, t)
            angle = rng.uniform(0, math.tau)
            reach = Vector((math.cos(angle), math.sin(angle), rng.uniform(-0.1, 0.35))) * rng.uniform(
                0.08, 0.4
            )
            made.tube([root, root + reach], [0.006, 0.004], 3, 0.1, 0.6, 1)
            at = aim(root + reach, (math.cos(angle), math.sin(angle), rng.uniform(-0.45, 0.1)))
            size = leaf * rng.uniform(0.75, 1.25)
            made.leaf(at, size, size * 0.85, rng.random(), 0.45 + 0.55 * t, 0.25)
            made.leaf(
                at @ Matrix.Rotation(0.9, 4, "Z"), size * 0.8, size * 0.6, rng.random(), 0.45 + 0.55 * t, 0.3
            )
            made.leaf(
                at @ Matrix.Rotation(-0.9, 4, "Z"), size * 0.8, size * 0.6, rng.random(), 0.45 + 0.55 * t, 0.3
            )
    return made.mesh("bush", [mat, stem])


def branch(rng, mat, stem, length=4.2, sprays=46, size=0.6) -> bpy.types.Mesh:
    """A drooping conifer branch along +y with flat sprays of foliage."""
    made = Builder()
    points = [Vector((0, length * t, length * (0.10 * t - 0.34 * t * t))) for t in (0, 0.25, 0.5, 0.75, 1.0)]
    made.tube(points, [0.075, 0.06, 0.045, 0.03, 0.012], 6, 0.0, 0.7, 1)
    for number in range(sprays):
        t = 0.15 + 0.85 * (number + rng.random()) / sprays
        root = common.curve_point(points, t)
        sign = -1 if number % 2 else 1
        far = (0.35 + 0.9 * math.sin(math.pi * min(1.0, 0.15 + 0.85 * t))) * rng.uniform(0.5, 1.1)
        forward = Vector(
            (sign * rng.uniform(0.7, 1.1), rng.uniform(0.3, 0.9), rng.uniform(-0.35, 0.1))
        ).normalized()
        tip = root + forward * far
        made.tube([root, tip], [0.018, 0.008], 3, 0.0, 0.7, 1)
        for part in range(3):
            base = root.lerp(tip, 0.3 + 0.35 * part)
            for swing in (-0.6, 0.6) if part < 2 else (-0.45, 0.0, 0.45):
                at = aim(base, forward + Vector((0, 0, -0.25))) @ Matrix.Rotation(swing, 4, "Z")
                made.leaf(
                    at, size * rng.uniform(0.7, 1.1), size * 0.30, rng.random(), 0.5 + 0.5 * rng.random(), 0.3
                )
    return made.mesh("branch", [mat, stem])


def clump(rng, mat, leaves=60, leaf=0.9) -> bpy.types.Mesh:
    """Distant foliage: a loose cloud of large leaves of radius about 2.5."""
    made = Builder()
    for _ in range(leaves):
        way = Vector((rng.gauss(0, 1), rng.gauss(0, 1), rng.gauss(0, 0.7))).normalized()
        at = aim(
            way * 2.5 * rng.random() ** 0.4, (way.x + rng.gauss(0, 0.5), way.y + rng.gauss(0, 0.5), -0.5)
        )
        made.leaf(
            at, leaf * rng.uniform(0.6, 1.3), leaf * 0.6, rng.random(), 0.55 + 0.45 * max(0.0, way.z), 0.3
        )
    return made.mesh("clump", [mat])


def trunk(rng, mat, radius=0.8, height=26.0, sides=56, rings=46) -> bpy.types.Mesh:
    """A redwood trunk from 0.6 m below ground: flared foot, vertical ridges of bark as geometry."""
    made, seed = Builder(), rng.uniform(0, 100)
    ridges = rng.randint(11, 15)
    vertices, faces, depth = [], [], []
    tints = []
    for ring in range(rings):
        t = ring / (rings - 1)
        z = -0.6 + (height + 0.6) * t**1.7
        width = radius * (1 - 0.55 * max(0.0, z) / height) + radius * 0.75 * math.exp(
            -max(0.0, z + 0.3) / (radius * 0.9)
        )
        lean = Vector((noise.noise((seed, 0, z * 0.05)), noise.noise((0, seed, z * 0.05)), 0)) * 0.5
        for side in range(sides):
            angle = math.tau * side / sides
            c, s = math.cos(angle), math.sin(angle)
            wander = noise.noise((c * 1.2 + seed, s * 1.2, z * 0.22)) * 2.2
            furrow = abs(math.sin(0.5 * ridges * angle + wander))
            lobes = noise.noise((c * 1.6, s * 1.6 + seed, z * 0.12))
            flare = math.exp(-max(0.0, z) / (radius * 1.1))
            relief = 1 + 0.11 * (furrow**0.6 - 0.6) + (0.10 + 0.30 * flare) * lobes
            vertices.append(Vector((c * width * relief, s * width * relief, z)) + lean)
            depth.append((0.35 + 0.65 * min(1.0, furrow * 1.4)) * (0.45 + 0.55 * min(1.0, max(0.0, z) / 1.2)))
            tints.append(0.75 * math.exp(-max(0.0, z) / 1.6))
    for ring in range(rings - 1):
        for side in range(sides):
            a, b = ring * sides + side, ring * sides + (side + 1) % sides
            faces.append((a, b, b + sides, a + sides))
    made.add(vertices, faces, 0.0, depth, 0, smooth=True)
    made.shades = [(tint, value, 0.0, 1.0) for tint, value in zip(tints, depth, strict=True)]
    for _ in range(7):  # dead snags
        z, angle = rng.uniform(3.0, 12.0), rng.uniform(0, math.tau)
        out = Vector((math.cos(angle), math.sin(angle), rng.uniform(-0.2, 0.5)))
        foot = Vector((out.x, out.y, 0)) * radius * 0.6 + Vector((0, 0, z))
        long = rng.uniform(0.5, 1.4)
        made.tube(
            [foot, foot + out * (radius * 0.3 + long * 0.5), foot + out * (radius * 0.3 + long)],
            [0.07, 0.05, 0.015],
            5,
            0.0,
            0.8,
        )
    return made.mesh("trunk", [mat])


def log(rng, mat, wood, cap, length=6.0, radius=0.42) -> bpy.types.Mesh:
    """A fallen trunk along x, resting on z = 0, with cut ends and bracket fungi."""
    made, seed, sides, rings = Builder(), rng.uniform(0, 100), 36, 24
    vertices, faces, depth = [], [], []
    for ring in range(rings):
        x = length * (ring / (rings - 1) - 0.5)
        width = radius * (1 - 0.18 * ring / rings) * (1 + 0.10 * noise.noise((x * 0.7, seed, 0)))
        for side in range(sides):
            angle = math.tau * side / sides
            c, s = math.cos(angle), math.sin(angle)
            furrow = abs(math.sin(5 * angle + 2 * noise.noise((c + seed, s, x * 0.5))))
            relief = 1 + 0.08 * (furrow**0.6 - 0.6) + 0.10 * noise.noise((c * 1.5, s * 1.5, x + seed))
            vertices.append(Vector((x, c * width * relief, radius * 0.8 + s * width * relief)))
            depth.append((0.4 + 0.6 * furrow) * (0.45 + 0.55 * (s * 0.5 + 0.5)))
    for ring in range(rings - 1):
        for side in range(sides):
            a, b = ring * sides + side, ring * sides + (side + 1) % sides
            faces.append((b, a, a + sides, b + sides))
    made.add(vertices, faces, 0.55, depth, 0, smooth=True)
    for ring, flip in ((0, False), (rings - 1, True)):
        rim = vertices[ring * sides : (ring + 1) * sides]
        order = list(range(sides))
        made.add(rim, [tuple(reversed(order) if flip else order)], 0.5, 0.9, 1)
    for _ in range(9):  # bracket fungi on both flanks
        x, sign = rng.uniform(-0.45, 0.45) * length, rng.choice((-1, 1))
        size, high = rng.uniform(0.07, 0.15), rng.uniform(0.5, 1.1) * radius
        centre = Vector((x, sign * radius * 0.86, high))
        fan = [centre] + [
            centre + Vector((math.cos(a) * size, sign * math.sin(a) * size * 1.3, 0.02))
            for a in [math.pi * i / 8 for i in range(9)]
        ]
        below = [point - Vector((0, 0, 0.05)) for point in fan[:1]]
        made.add(
            fan + below,
            [(0, i, i + 1) for i in range(1, 9)] + [(10, i + 1, i) for i in range(1, 9)],
            rng.random(),
            1.0,
            2,
        )
    return made.mesh("log", [mat, wood, cap])


def rock(rng, mat) -> bpy.types.Mesh:
    """A boulder of radius about one."""
    import bmesh

    shape, seed = bmesh.new(), rng.uniform(0, 100)
    bmesh.ops.create_icosphere(shape, subdivisions=4, radius=1.0)
    made = Builder()
    vertices, depth = [], []
    for vertex in shape.verts:
        p = vertex.co
        size = (
            1
            + 0.38 * noise.noise(p * 0.9 + Vector((seed, 0, 0)))
            + 0.13 * noise.noise(p * 2.6 + Vector((0, seed, 0)))
        )
        # Facets: pull the surface towards a few planes.
        chip = noise.cell_vector(p * 1.3 + Vector((seed, seed, 0))).x
        vertices.append(Vector((p.x * 1.15, p.y, p.z * 0.72)) * (size + 0.05 * chip))
        depth.append(0.35 + 0.65 * min(1.0, max(0.0, p.z + 0.55)))
    made.add(
        vertices,
        [[vertex.index for vertex in face.verts] for face in shape.faces],
        0.5,
        depth,
        0,
        smooth=True,
    )
    shape.free()
    return made.mesh("rock", [mat])


def litter(rng, mat, leaves=34, spread=0.8) -> bpy.types.Mesh:
    """Fallen leaves on the ground."""
    made = Builder()
    for _ in range(leaves):
        far, turn = spread * math.sqrt(rng.random()), rng.uniform(0, math.tau)
        angle, size = rng.uniform(0, math.tau), rng.uniform(0.08, 0.14)
        at = aim(
            (far * math.cos(turn), far * math.sin(turn), rng.uniform(0.015, 0.04)),
            (math.cos(angle), math.sin(angle), rng.uniform(0.0, 0.35)),
        )
        made.leaf(at, size, size * 0.6, rng.random(), rng.uniform(0.6, 1.0), 0.2)
    return made.mesh("litter", [mat])


# --- things that move on their own ----------------------------------------------------------------------


def single_leaf(rng, mat, size=0.13) -> bpy.types.Mesh:
    """A maple-like leaf about its own centre."""
    made = Builder()
    for swing, scale in ((0.0, 1.0), (0.95, 0.8), (-0.95, 0.8)):
        at = Matrix.Translation((0, -size * 0.3, 0)) @ Matrix.Rotation(swing, 4, "Z")
        made.leaf(at, size * scale, size * 0.55 * scale, rng.random(), 1.0, 0.2)
    return made.mesh("drifting leaf", [mat])


def wing(mat, length: float, width: float, sweep: float, name: str) -> bpy.types.Mesh:
    """A right wing along +x with a scalloped edge; mirror it by a scale of -1 in x."""
    made = Builder()
    lead = [Vector((length * t, width * (0.45 - sweep * t * t), 0)) for t in (0, 0.35, 0.7, 1.0)]
    trail = [
        Vector((length * t, -width * (0.55 - 0.35 * t * t + sweep * t), 0)) for t in (0, 0.35, 0.7, 0.97)
    ]
    faces = [(i, i + 4, i + 5, i + 1) for i in range(3)]
    for index, face in enumerate(faces):
        made.add([(lead + trail)[i] for i in face], [(0, 1, 2, 3)], 0.1 + 0.4 * index, 1.0)
    return made.mesh(name, [mat])


def bird_body(mat, beak, length=0.42) -> bpy.types.Mesh:
    """A bird's body along +y with head, beak and tail."""
    made = Builder()
    profile = [
        (-0.5, 0.02),
        (-0.32, 0.10),
        (-0.05, 0.17),
        (0.18, 0.14),
        (0.29, 0.105),
        (0.40, 0.115),
        (0.5, 0.05),
    ]
    made.tube([(0, length * y, 0) for y, _ in profile], [length * r for _, r in profile], 10, 0.3, 1.0)
    tip = [
        Vector((x, length * y, z))
        for x, y, z in ((0.02, 0.48, 0.01), (-0.02, 0.48, 0.01), (0, 0.48, -0.02), (0, 0.64, 0))
    ]
    made.add(tip, [(0, 1, 3), (1, 2, 3), (2, 0, 3)], 0.5, 1.0, 1)
    tail = [
        Vector((x * length, y * length, 0.0))
        for x, y in ((-0.05, -0.35), (0.05, -0.35), (0.16, -0.95), (0, -0.88), (-0.16, -0.95))
    ]
    made.add(tail, [(0, 1, 2, 3), (0, 3, 4)], 0.9, 1.0)
    return made.mesh("bird", [mat, beak])


def lantern(paper, frame) -> bpy.types.Mesh:
    """A paper lantern that hangs 0.9 m below its pivot at the origin."""
    made = Builder()
    made.tube([(0, 0, 0), (0, 0, -0.62)], [0.010, 0.010], 5, slot=1)
    levels = [(-0.62, 0.05), (-0.66, 0.16), (-0.78, 0.20), (-0.94, 0.20), (-1.06, 0.15), (-1.10, 0.05)]
    made.tube([(0, 0, z) for z, _ in levels], [r for _, r in levels], 6)
    for side in range(6):
        angle = math.tau * side / 6
        bars = [(math.cos(angle) * r * 1.02, math.sin(angle) * r * 1.02, z) for z, r in levels]
        made.tube(bars, [0.013] * len(bars), 4, slot=1)
    for z, r in (levels[0], levels[1], levels[4], levels[5]):
        ring = [(math.cos(a) * r, math.sin(a) * r, z) for a in [math.tau * i / 6 for i in range(7)]]
        made.tube(ring, [0.014] * 7, 4, slot=1)
    made.smooth = [False] * len(made.smooth)
    return made.mesh("lantern", [paper, frame])


def post(wood, height=2.5, arm=0.8) -> bpy.types.Mesh:
    """A crooked post at the origin whose arm ends at (arm, 0, height)."""
    made = Builder()
    made.tube([(0, 0, -0.3), (0.03, 0.02, 1.2), (0, 0, height * 0.9)], [0.075, 0.06, 0.055], 8)
    made.tube([(0, 0, height * 0.86), (arm * 0.4, 0, height * 1.02), (arm, 0, height)], [0.05, 0.04, 0.03], 7)
    made.tube([(0, 0, height * 0.62), (arm * 0.42, 0, height * 1.0)], [0.022, 0.022], 6)
    return made.mesh("post", [wood])
