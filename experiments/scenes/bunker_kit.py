"""Building blocks of the bunker scene: materials with a noise-free ambient term, and the mesh builder `Part`.

The ambient light is emission (base colour times a sky/ground gradient times short-range occlusion) instead
of diffuse bounces: the truth stays clean at few samples. For the same reason diffuse rays see no emission,
and glossy rays see lamps dimmed (rare hits of bright lamps are what fireflies are made of). UV coordinates
are metres on every surface.
"""

import math
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import bpy
from mathutils import Matrix, Vector

sys.path.insert(0, str(Path(__file__).resolve().parent))
import common as co

Point = Sequence[float]

AMBIENT_UP = (0.18, 0.225, 0.27)
AMBIENT_DOWN = (0.16, 0.135, 0.11)


# --- materials ------------------------------------------------------------------------------------------


def ambient_group() -> bpy.types.NodeTree:
    """Node group: base colour, metallic -> emitted ambient light (made once a file)."""
    if "ambient" in bpy.data.node_groups:
        return bpy.data.node_groups["ambient"]
    tree = bpy.data.node_groups.new("ambient", "ShaderNodeTree")
    tree.interface.new_socket("Color", in_out="INPUT", socket_type="NodeSocketColor")
    tree.interface.new_socket("Metallic", in_out="INPUT", socket_type="NodeSocketFloat")
    tree.interface.new_socket("Light", in_out="OUTPUT", socket_type="NodeSocketColor")
    new, link = tree.nodes.new, tree.links.new
    source, sink = new("NodeGroupInput"), new("NodeGroupOutput")
    geometry, axes, height = (
        new("ShaderNodeNewGeometry"),
        new("ShaderNodeSeparateXYZ"),
        new("ShaderNodeMapRange"),
    )
    height.inputs["From Min"].default_value = -1.0
    link(geometry.outputs["Normal"], axes.inputs[0])
    link(axes.outputs["Z"], height.inputs["Value"])

    def mix(blend: str, factor: object, a: object, b: object) -> bpy.types.NodeSocket:
        node = new("ShaderNodeMix")
        node.data_type, node.blend_type = "RGBA", blend
        for number, value in ((0, factor), (6, a), (7, b)):
            if isinstance(value, bpy.types.NodeSocket):
                link(value, node.inputs[number])
            else:
                node.inputs[number].default_value = value
        return node.outputs[2]

    light = mix("MIX", height.outputs["Result"], (*AMBIENT_DOWN, 1), (*AMBIENT_UP, 1))
    occlusion = new("ShaderNodeAmbientOcclusion")
    occlusion.samples, occlusion.inputs["Distance"].default_value = 2, 0.9
    light = mix("MULTIPLY", 1.0, light, occlusion.outputs["Color"])
    light = mix("MULTIPLY", 1.0, light, source.outputs["Color"])
    dim = mix("MULTIPLY", 1.0, light, (0.45, 0.45, 0.45, 1))
    light = mix("MIX", source.outputs["Metallic"], light, dim)
    light = mix("MIX", new("ShaderNodeLightPath").outputs["Is Diffuse Ray"], light, (0, 0, 0, 1))
    link(light, sink.inputs["Light"])
    return tree


def finish(nodes: co.Nodes, color: object, metallic: object = 0.0) -> None:
    """Connect base colour, metallic and the ambient emission that belongs to them."""
    group = nodes.node("ShaderNodeGroup", node_tree=ambient_group())
    nodes.connect(color, group.inputs["Color"])
    nodes.connect(metallic, group.inputs["Metallic"])
    nodes.set("Base Color", color)
    nodes.set("Metallic", metallic)
    nodes.set("Emission Color", group.outputs["Light"])
    nodes.set("Emission Strength", 1.0)


def _new(name: str) -> tuple[bpy.types.Material, co.Nodes]:
    mat = co.material(name)
    mat.cycles.emission_sampling = "NONE"  # ambient light is not a lamp
    return mat, co.Nodes(mat)


def cast_concrete(
    name: str,
    tone: co.Color,
    panel: tuple[float, float],
    band: co.Color | None = None,
    stain: float = 0.6,
    rough: tuple[float, float] = (0.45, 0.85),
    wet: float = 0.0,
    shift: Point = (0, 0, 0),
) -> bpy.types.Material:
    """Cast concrete: panel seams, blotches, vertical stains, a painted band up to 1.15 m, wet patches.

    `shift` moves the stains (metres): another one shows another wall.
    """
    mat, n = _new(name)
    uv = n.coordinates("UV")
    place = n.world_position()
    world = n.mapping(place, location=shift)
    bricks = n.node(
        "ShaderNodeTexBrick",
        {
            "Vector": uv, "Color1": (1.06, 1.05, 1.02), "Color2": (0.84, 0.86, 0.88),
            "Mortar": (0.34, 0.33, 0.32), "Scale": 1.0, "Mortar Size": 0.016, "Mortar Smooth": 0.2,
            "Brick Width": panel[0], "Row Height": panel[1],
        },
        offset=0.0,
    )  # fmt: skip
    blotch = n.noise(world, 0.9, 4.0, 0.6)
    color = n.mix(n.step(blotch, 0.35, 0.7), [c * 0.78 for c in tone], [min(c * 1.12, 1) for c in tone])
    grain = n.noise(world, 14.0, 2.0)
    color = n.mix(n.step(grain, 0.58, 0.72, 0, 0.35), color, (0.12, 0.115, 0.11))
    if band is not None:
        height = n.node("ShaderNodeSeparateXYZ", {0: place}).outputs[2]
        worn = n.math("GREATER_THAN", n.noise(world, 3.1, 4.0, 0.65), 0.40)
        inside = n.math("MULTIPLY", n.math("LESS_THAN", height, 1.15), worn)
        color = n.mix(inside, color, band)
        line = n.math("LESS_THAN", n.math("ABSOLUTE", n.math("SUBTRACT", height, 1.22)), 0.045)
        color = n.mix(n.math("MULTIPLY", line, worn), color, (0.72, 0.62, 0.30))
    streak = n.noise(n.mapping(world, (5.0, 5.0, 0.35)), 1.0, 3.0, 0.6)
    color = n.mix(n.step(streak, 0.52, 0.75, 0, stain), color, (0.09, 0.066, 0.045))
    color = n.mix(1.0, color, bricks.outputs["Color"], "MULTIPLY")
    n.set("Roughness", n.step(blotch, 0.35, 0.62, rough[0], rough[1]))
    if wet:
        puddle = n.step(n.noise(world, 0.55, 2.0), 0.50, 0.56)
        color = n.mix(puddle, color, n.mix(1.0, color, (wet,) * 3, "MULTIPLY"))
        n.set("Roughness", n.step(n.noise(world, 0.55, 2.0), 0.50, 0.56, rough[1], rough[0]))
    finish(n, color)
    n.set("Normal", n.bump(n.math("ADD", bricks.outputs["Fac"], n.math("MULTIPLY", grain, -0.25)), 0.02, 0.5))
    return mat


def paint(
    name: str,
    color: co.Color,
    wear: float = 0.38,
    rough: tuple[float, float] = (0.22, 0.45),
    under: co.Color = (0.30, 0.17, 0.09),
) -> bpy.types.Material:
    """Painted steel, chipped to rust where a noise falls below `wear`."""
    mat, n = _new(name)
    at = n.coordinates()
    chip = n.noise(at, 5.0, 4.0, 0.65)
    shade = n.step(n.noise(at, 1.7, 2.0), 0.3, 0.7, 0.75, 1.1)
    full = n.mix(
        1.0, color, n.node("ShaderNodeCombineColor", {0: shade, 1: shade, 2: shade}).outputs[0], "MULTIPLY"
    )
    worn = n.math("LESS_THAN", chip, wear)
    n.set(
        "Roughness",
        n.math("MAXIMUM", n.step(chip, 0.35, 0.65, rough[1], rough[0]), n.math("MULTIPLY", worn, 0.7)),
    )
    finish(n, n.mix(worn, full, under))
    return mat


def metal(name: str, color: co.Color, rough: tuple[float, float], rust: float = 0.0) -> bpy.types.Material:
    """Bare metal with smudges in its roughness; rust where a noise exceeds 1 - `rust`."""
    mat, n = _new(name)
    at = n.coordinates()
    smudge = n.noise(at, 3.5, 3.0, 0.6)
    n.set("Roughness", n.step(smudge, 0.35, 0.65, rough[0], rough[1]))
    full = n.mix(n.step(smudge, 0.35, 0.65), color, [c * 0.8 for c in color])
    if not rust:
        finish(n, full, 1.0)
        return mat
    spots = n.step(n.noise(at, 2.3, 4.0, 0.65), 0.62 - rust, 0.70 - rust)
    finish(n, n.mix(spots, full, (0.24, 0.105, 0.045)), n.math("SUBTRACT", 1.0, spots))
    return mat


def plates(
    name: str, color: co.Color, size: float, rough: tuple[float, float], metallic: float
) -> bpy.types.Material:
    """Riveted or galvanised plates: a tone a cell (Voronoi) and dark seams."""
    mat, n = _new(name)
    uv = n.coordinates("UV")
    cells = n.voronoi(uv, 9.0, output="Color")
    seams = n.node(
        "ShaderNodeTexBrick",
        {"Vector": uv, "Color1": (1, 1, 1), "Color2": (0.8, 0.8, 0.8), "Mortar": (0.2, 0.2, 0.2),
         "Scale": 1.0, "Mortar Size": 0.014, "Brick Width": size, "Row Height": size},
        offset=0.5,
    ).outputs["Color"]  # fmt: skip
    tone = n.mix(n.step(cells, 0.2, 0.8), [c * 0.75 for c in color], color)
    n.set("Roughness", n.step(cells, 0.2, 0.8, rough[0], rough[1]))
    finish(n, n.mix(1.0, tone, seams, "MULTIPLY"), metallic)
    return mat


def stripes(
    name: str, a: co.Color = (0.75, 0.52, 0.03), b: co.Color = (0.025, 0.025, 0.025)
) -> bpy.types.Material:
    """Diagonal warning stripes, 0.16 m wide, worn."""
    mat, n = _new(name)
    uv = n.coordinates("UV")
    axes = n.node("ShaderNodeSeparateXYZ", {0: uv})
    phase = n.math("FRACT", n.math("MULTIPLY", n.math("ADD", axes.outputs[0], axes.outputs[1]), 3.1))
    worn = n.math("LESS_THAN", n.noise(uv, 6.0, 4.0, 0.7), 0.36)
    color = n.mix(n.math("GREATER_THAN", phase, 0.5), a, b)
    n.set("Roughness", 0.45)
    finish(n, n.mix(worn, color, (0.22, 0.21, 0.20)))
    return mat


def wood(name: str, color: co.Color) -> bpy.types.Material:
    """Planks of a crate, 0.14 m wide with dark joints."""
    mat, n = _new(name)
    uv = n.coordinates("UV")
    planks = n.node(
        "ShaderNodeTexBrick",
        {"Vector": uv, "Color1": color, "Color2": [c * 0.62 for c in color], "Mortar": (0.02, 0.014, 0.01),
         "Scale": 1.0, "Mortar Size": 0.009, "Brick Width": 3.0, "Row Height": 0.14},
        offset=0.37,
    ).outputs["Color"]  # fmt: skip
    grain = n.noise(n.mapping(uv, (2.0, 22.0, 2.0)), 1.0, 3.0, 0.6)
    n.set("Roughness", 0.75)
    finish(n, n.mix(n.step(grain, 0.45, 0.75, 0, 0.55), planks, (0.10, 0.055, 0.028)))
    return mat


def glow(name: str, color: co.Color, strength: float) -> bpy.types.Material:
    """The lit glass of a lamp: it looks bright; point and spot lamps beside it do the lighting."""
    mat = co.material(name, (0.8, 0.8, 0.8), 0.4, emission=color)
    mat.cycles.emission_sampling = "NONE"
    n = co.Nodes(mat)
    n.set("Emission Strength", seen(n, strength, min(strength, 1.6)))
    return mat


def seen(n: co.Nodes, camera: float, glossy: float) -> bpy.types.NodeSocket:
    """An emission strength by the kind of ray: the camera's, a reflection's, none for diffuse rays."""
    path = n.node("ShaderNodeLightPath")
    direct = n.math("MULTIPLY", path.outputs["Is Camera Ray"], camera)
    return n.math("ADD", direct, n.math("MULTIPLY", path.outputs["Is Glossy Ray"], glossy))


def screen(name: str, color: co.Color, rows: float, shift: float) -> bpy.types.Material:
    """A display: bars of `color`, rows of text-like blocks and a frame of grid lines."""
    mat, n = _new(name)
    uv = n.mapping(n.coordinates("UV"), location=(shift, shift * 1.7, 0))
    text = n.node(
        "ShaderNodeTexBrick",
        {"Vector": uv, "Color1": (1, 1, 1), "Color2": (0.05, 0.05, 0.05), "Mortar": (0, 0, 0), "Scale": rows,
         "Mortar Size": 0.09, "Brick Width": 0.62, "Row Height": 0.34, "Bias": -0.1},
        offset=0.3,
    ).outputs["Color"]  # fmt: skip
    hot = n.math("GREATER_THAN", n.noise(n.mapping(uv, (rows, rows * 0.4, 1)), 1.0, 1.0), 0.58)
    tint = n.mix(hot, color, (1.0, 0.75, 0.25))
    n.set("Base Color", (0.02, 0.025, 0.03))
    n.set("Roughness", 0.18)
    n.set("Emission Color", n.mix(1.0, n.mix(0.93, (0.2, 0.25, 0.3), text), tint, "MULTIPLY"))
    n.set("Emission Strength", seen(n, 1.4, 0.8))
    return mat


def library(shift: Point = (0, 0, 0)) -> dict[str, bpy.types.Material]:
    """All materials of the bunker by short name; `shift` moves the stains of the concrete (metres)."""
    ambient_group()
    concrete = partial(cast_concrete, shift=shift)
    mats = {
        "wall": concrete("wall", (0.40, 0.39, 0.365), (2.4, 1.3), band=(0.045, 0.20, 0.20)),
        "hallwall": concrete(
            "hallwall", (0.36, 0.365, 0.36), (3.0, 1.6), band=(0.28, 0.075, 0.045), stain=0.75
        ),
        "ceiling": concrete("ceiling", (0.30, 0.30, 0.295), (2.4, 1.2), stain=0.4),
        "floor": concrete(
            "floor", (0.30, 0.285, 0.265), (2.0, 2.0), stain=0.35, rough=(0.20, 0.62), wet=0.55
        ),
        "pit": concrete("pit", (0.16, 0.15, 0.14), (1.2, 0.6), stain=0.6),
        "column": concrete("column", (0.45, 0.44, 0.41), (1.1, 1.4), stain=0.8),
        "steel": metal("steel", (0.58, 0.58, 0.60), (0.20, 0.40)),
        "chrome": metal("chrome", (0.78, 0.79, 0.80), (0.15, 0.22)),
        "copper": metal("copper", (0.80, 0.42, 0.24), (0.20, 0.38)),
        "brass": metal("brass", (0.80, 0.60, 0.26), (0.20, 0.35)),
        "rusty": metal("rusty", (0.46, 0.44, 0.42), (0.30, 0.50), rust=0.16),
        "galvanised": plates("galvanised", (0.62, 0.64, 0.66), 1.5, (0.25, 0.45), 1.0),
        "plate": plates("plate", (0.30, 0.32, 0.34), 0.9, (0.28, 0.45), 1.0),
        "rubber": paint("rubber", (0.022, 0.022, 0.024), 0.0, (0.5, 0.65)),
        "stripes": stripes("stripes"),
        "stripes_red": stripes("stripes_red", (0.60, 0.045, 0.03), (0.70, 0.68, 0.62)),
        "wood": wood("wood", (0.42, 0.26, 0.13)),
        "wood_green": wood("wood_green", (0.15, 0.20, 0.10)),
        "white_line": paint("white_line", (0.72, 0.71, 0.66), 0.40, under=(0.28, 0.27, 0.25)),
        "yellow_line": paint("yellow_line", (0.75, 0.50, 0.04), 0.40, under=(0.28, 0.27, 0.25)),
        "lamp_warm": glow("lamp_warm", (1.0, 0.72, 0.38), 5.0),
        "lamp_cold": glow("lamp_cold", (0.80, 0.92, 1.0), 4.5),
        "lamp_red": glow("lamp_red", (1.0, 0.07, 0.03), 3.0),
        "lamp_green": glow("lamp_green", (0.10, 1.0, 0.25), 2.0),
        "flicker": glow("flicker", (1.0, 1.0, 1.0), 5.0),
        "screen_a": screen("screen_a", (0.10, 0.85, 0.75), 9.0, 0.0),
        "screen_b": screen("screen_b", (0.25, 0.55, 1.0), 7.0, 3.3),
        "screen_c": screen("screen_c", (0.30, 1.0, 0.30), 11.0, 7.9),
    }
    for name, color in {
        "teal": (0.03, 0.26, 0.26), "red": (0.58, 0.035, 0.025), "yellow": (0.74, 0.44, 0.025),
        "blue": (0.04, 0.14, 0.42), "green": (0.07, 0.22, 0.08), "grey": (0.26, 0.28, 0.29),
        "white": (0.66, 0.65, 0.60), "orange": (0.72, 0.19, 0.025), "dark": (0.055, 0.06, 0.068),
    }.items():  # fmt: skip
        mats[name] = paint(name, color)
    return mats


# --- meshes ---------------------------------------------------------------------------------------------


class Part:
    """Collects boxes, tubes and quads of several materials into one mesh; UVs are metres."""

    def __init__(self, mats: dict[str, bpy.types.Material]):
        self.mats = mats
        self.names: list[str] = []
        self.vertices: list[Vector] = []
        self.faces: list[tuple[tuple[int, ...], int, bool]] = []
        self.uvs: list[tuple[float, float]] = []

    def face(
        self,
        corners: Sequence[Point],
        mat: str,
        uv: Sequence[tuple[float, float]] | None = None,
        smooth=False,
    ):
        """One polygon, counter-clockwise seen from outside; planar UVs by its dominant axis unless given."""
        if mat not in self.names:
            self.names.append(mat)
        points = [Vector(corner) for corner in corners]
        if uv is None:
            normal = (points[1] - points[0]).cross(points[2] - points[0])
            axis = max(range(3), key=lambda i: abs(normal[i]))
            a, b = ((1, 2), (0, 2), (0, 1))[axis]
            uv = [(point[a], point[b]) for point in points]
        start = len(self.vertices)
        self.vertices += points
        self.uvs += uv
        self.faces.append((tuple(range(start, start + len(points))), self.names.index(mat), smooth))

    def box(self, low: Point, high: Point, mat: str, turn: Matrix | None = None) -> "Part":
        """Axis-aligned box between two corners, then `turn` (4x4) applied; UVs are of the unturned box."""
        (a, b, c), (d, e, f) = low, high
        p = [(x, y, z) for x in (a, d) for y in (b, e) for z in (c, f)]
        sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        for number, side in enumerate(sides):
            flat = [p[i] for i in side]
            u, v = ((1, 2), (0, 2), (0, 1))[number // 2]
            corners = flat if turn is None else [turn @ Vector(corner) for corner in flat]
            self.face(corners, mat, [(corner[u], corner[v]) for corner in flat])
        return self

    def block(self, centre: Point, size: Point, mat: str, yaw: float = 0.0) -> "Part":
        """Box by centre and size, turned about the vertical."""
        half = Vector(size) / 2
        turn = Matrix.Translation(Vector(centre)) @ Matrix.Rotation(yaw, 4, "Z")
        return (
            self.box(-half, half, mat, None if yaw == 0 else turn)
            if yaw
            else self.box(Vector(centre) - half, Vector(centre) + half, mat)
        )

    def tube(
        self, points: Sequence[Point], radius: float | Sequence[float], mat: str, sides=12, caps=True
    ) -> "Part":
        """Round tube through `points` (one radius, or one a point)."""
        centres = [Vector(point) for point in points]
        radii = [radius] * len(centres) if isinstance(radius, int | float) else list(radius)
        rings, lengths, length = [], [], 0.0
        turn, tangent = None, None
        for i, centre in enumerate(centres):
            ahead, behind = centres[min(i + 1, len(centres) - 1)], centres[max(i - 1, 0)]
            new = (ahead - behind).normalized() if (ahead - behind).length > 1e-9 else tangent
            turn = new.to_track_quat("Z", "Y") if turn is None else tangent.rotation_difference(new) @ turn
            tangent = new
            length += (centre - behind).length
            lengths.append(length)
            angles = [math.tau * k / sides for k in range(sides + 1)]
            rings.append(
                [centre + turn @ Vector((radii[i] * math.cos(t), radii[i] * math.sin(t), 0)) for t in angles]
            )
        widest = max(radii)
        for i in range(len(rings) - 1):
            for k in range(sides):
                u0, u1 = math.tau * k / sides * widest, math.tau * (k + 1) / sides * widest
                uv = [(u0, lengths[i]), (u1, lengths[i]), (u1, lengths[i + 1]), (u0, lengths[i + 1])]
                self._shared((rings[i][k], rings[i][k + 1], rings[i + 1][k + 1], rings[i + 1][k]), mat, uv)
        if caps:
            self.face(rings[0][:-1][::-1], mat)
            self.face(rings[-1][:-1], mat)
        return self

    def _shared(self, corners: Sequence[Vector], mat: str, uv: Sequence[tuple[float, float]]) -> None:
        self.face(corners, mat, uv, smooth=True)

    def rod(self, a: Point, b: Point, radius: float, mat: str, sides: int = 12) -> "Part":
        """Straight tube."""
        return self.tube((a, b), radius, mat, sides)

    def ring(
        self, centre: Point, axis: str, radius: float, thick: float, mat: str, steps=20, sides=8
    ) -> "Part":
        """Torus about the axis "X", "Y" or "Z" (a hand wheel, a hoop)."""
        u, v = {"X": ((0, 1, 0), (0, 0, 1)), "Y": ((1, 0, 0), (0, 0, 1)), "Z": ((1, 0, 0), (0, 1, 0))}[axis]
        at = lambda t: Vector(centre) + radius * (math.cos(t) * Vector(u) + math.sin(t) * Vector(v))  # noqa: E731
        return self.tube([at(math.tau * i / steps) for i in range(steps + 1)], thick, mat, sides, caps=False)

    def object(
        self, name: str, location: Point = (0, 0, 0), yaw: float = 0.0, parent=None
    ) -> bpy.types.Object:
        """Make the object. Vertices at equal places are merged, so that smooth faces share normals."""
        return co.add(self.data(name), name, location, (0, 0, yaw), parent=parent)

    def data(self, name: str) -> bpy.types.Mesh:
        """Make the mesh."""
        index: dict[tuple, int] = {}
        vertices: list[Vector] = []
        faces, uvs, order = [], [], []
        for corners, slot, smooth in self.faces:
            face = []
            for corner in corners:
                point = self.vertices[corner]
                key = (round(point.x, 5), round(point.y, 5), round(point.z, 5), smooth)
                if key not in index:
                    index[key] = len(vertices)
                    vertices.append(point)
                face.append(index[key])
                uvs.append(self.uvs[corner])
            faces.append(face)
            order.append((slot, smooth))
        data = bpy.data.meshes.new(name)
        data.from_pydata(vertices, [], faces)
        for mat in self.names:
            data.materials.append(self.mats[mat])
        data.polygons.foreach_set("material_index", [slot for slot, _ in order])
        data.polygons.foreach_set("use_smooth", [smooth for _, smooth in order])
        layer = data.uv_layers.new(name="UV")
        layer.data.foreach_set("uv", [value for pair in uvs for value in pair])
        data.update()
        return data


def bend(points: Sequence[Point], radius: float, steps: int = 5) -> list[Vector]:
    """Round the corners of a polyline of pipe with arcs of about `radius`."""
    path = [Vector(points[0])]
    for before, corner, after in zip(points, points[1:], points[2:], strict=False):
        a, b, c = Vector(before), Vector(corner), Vector(after)
        start = b + (a - b).normalized() * radius
        end = b + (c - b).normalized() * radius
        path += [
            start * (1 - t) ** 2 + b * (2 * t * (1 - t)) + end * t**2
            for t in (i / steps for i in range(steps + 1))
        ]
    return [*path, Vector(points[-1])]


def sign(
    text: str, size: float, mat: bpy.types.Material, location: Point, rotation: Point
) -> bpy.types.Object:
    """Painted letters as a flat mesh."""
    curve = bpy.data.curves.new("sign", "FONT")
    curve.body, curve.size, curve.align_x, curve.align_y = text, size, "CENTER", "CENTER"
    curve.resolution_u = 2
    shape = co.add(curve, "sign")
    data = bpy.data.meshes.new_from_object(shape)
    bpy.data.objects.remove(shape)
    data.materials.clear()
    data.materials.append(mat)
    return co.add(data, "sign", location, rotation)


def spin(ob: bpy.types.Object, frames: int, base: Matrix, axis: str, rate: Callable[[int], float]) -> None:
    """Key a rotation of rate(frame) radians about a local axis of `base`."""
    co.key_motion(ob, frames, lambda f: base @ Matrix.Rotation(rate(f), 4, axis))
