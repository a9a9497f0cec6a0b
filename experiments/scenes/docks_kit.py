"""What the docks are made with: the table of materials, sun and sky, a mesh builder, exact key-frames.

Lengths are metres. Each material is one Principled BSDF over procedural textures that read the metric uv and
the tint of a part. A share of the ambient light is emission (base colour times a colour by normal), which
needs no sampling; such materials are not lamps (`emission_sampling` is off).
"""

import math

import bpy
from mathutils import Matrix, Vector

SUN = Vector((0.66, -0.66, 0.40)).normalized()  # towards the sun: over the water, low
WATER_Z = -1.3

# name: pattern, colours a and b, roughness from..to, pattern cells a metre along and across, metallic
MATERIALS = {
    "plank": ("grain", (0.20, 0.125, 0.07), (0.42, 0.29, 0.18), (0.16, 0.55), (0.35, 7.0), 0.0),
    "pile": ("grain", (0.10, 0.075, 0.05), (0.23, 0.17, 0.11), (0.25, 0.6), (0.6, 6.0), 0.0),
    "timber": ("grain", (0.055, 0.032, 0.018), (0.12, 0.072, 0.042), (0.5, 0.8), (0.5, 8.0), 0.0),
    "crate": ("grain", (0.36, 0.22, 0.10), (0.56, 0.38, 0.20), (0.45, 0.75), (0.9, 9.0), 0.0),
    "hull_brown": ("grain", (0.15, 0.075, 0.035), (0.30, 0.165, 0.08), (0.22, 0.5), (0.4, 3.0), 0.0),
    "hull_dark": ("grain", (0.06, 0.05, 0.045), (0.14, 0.11, 0.09), (0.22, 0.5), (0.4, 3.0), 0.0),
    "hull_honey": ("grain", (0.33, 0.18, 0.07), (0.50, 0.31, 0.14), (0.22, 0.5), (0.4, 3.0), 0.0),
    "mast": ("grain", (0.36, 0.23, 0.12), (0.52, 0.36, 0.20), (0.4, 0.6), (0.4, 5.0), 0.0),
    "rope": ("grain", (0.42, 0.31, 0.17), (0.60, 0.47, 0.28), (0.8, 0.9), (4.0, 2.0), 0.0),
    "tar_rope": ("grain", (0.07, 0.05, 0.035), (0.13, 0.10, 0.07), (0.7, 0.8), (4.0, 2.0), 0.0),
    "plaster_cream": ("blotch", (0.74, 0.62, 0.43), (0.86, 0.78, 0.62), (0.8, 0.95), (0.9, 0.9), 0.0),
    "plaster_ochre": ("blotch", (0.66, 0.40, 0.15), (0.80, 0.55, 0.26), (0.8, 0.95), (0.9, 0.9), 0.0),
    "plaster_rose": ("blotch", (0.62, 0.30, 0.22), (0.76, 0.45, 0.35), (0.8, 0.95), (0.9, 0.9), 0.0),
    "plaster_blue": ("blotch", (0.30, 0.43, 0.50), (0.46, 0.58, 0.62), (0.8, 0.95), (0.9, 0.9), 0.0),
    "stone": ("brick", (0.30, 0.27, 0.23), (0.46, 0.41, 0.35), (0.6, 0.85), (1.6, 1.6), 0.0),
    "cobble": ("cobble", (0.13, 0.12, 0.115), (0.36, 0.31, 0.26), (0.14, 0.5), (2.6, 2.6), 0.0),
    "tile": ("blotch", (0.40, 0.11, 0.05), (0.60, 0.22, 0.10), (0.5, 0.75), (0.8, 0.8), 0.0),
    "slate": ("blotch", (0.13, 0.15, 0.18), (0.24, 0.26, 0.30), (0.3, 0.55), (0.8, 0.8), 0.0),
    "sail": ("blotch", (0.66, 0.56, 0.42), (0.82, 0.74, 0.60), (0.8, 0.9), (0.7, 0.7), 0.0),
    "sail_red": ("stripe", (0.52, 0.075, 0.045), (0.80, 0.70, 0.54), (0.8, 0.9), (0.55, 1.0), 0.0),
    "sail_blue": ("stripe", (0.06, 0.16, 0.34), (0.80, 0.72, 0.58), (0.8, 0.9), (0.55, 1.0), 0.0),
    "awning_red": ("stripe", (0.62, 0.06, 0.04), (0.84, 0.76, 0.62), (0.75, 0.9), (1.6, 1.0), 0.0),
    "awning_blue": ("stripe", (0.05, 0.20, 0.42), (0.84, 0.76, 0.62), (0.75, 0.9), (1.6, 1.0), 0.0),
    "awning_green": ("stripe", (0.09, 0.26, 0.10), (0.82, 0.62, 0.20), (0.75, 0.9), (1.6, 1.0), 0.0),
    "red": ("blotch", (0.50, 0.05, 0.03), (0.66, 0.10, 0.06), (0.6, 0.8), (2.0, 2.0), 0.0),
    "blue": ("blotch", (0.04, 0.13, 0.32), (0.09, 0.22, 0.45), (0.6, 0.8), (2.0, 2.0), 0.0),
    "green": ("blotch", (0.06, 0.17, 0.06), (0.14, 0.30, 0.09), (0.6, 0.8), (2.0, 2.0), 0.0),
    "yellow": ("blotch", (0.74, 0.42, 0.05), (0.86, 0.58, 0.12), (0.6, 0.8), (2.0, 2.0), 0.0),
    "sack": ("blotch", (0.42, 0.32, 0.19), (0.60, 0.49, 0.32), (0.85, 0.95), (3.0, 3.0), 0.0),
    "skin": ("blotch", (0.58, 0.33, 0.22), (0.64, 0.40, 0.28), (0.6, 0.7), (3.0, 3.0), 0.0),
    "leaf": ("blotch", (0.05, 0.13, 0.03), (0.15, 0.28, 0.07), (0.6, 0.8), (4.0, 4.0), 0.0),
    "white": ("blotch", (0.78, 0.77, 0.74), (0.86, 0.85, 0.82), (0.6, 0.7), (3.0, 3.0), 0.0),
    "iron": ("blotch", (0.20, 0.19, 0.18), (0.34, 0.31, 0.28), (0.25, 0.45), (3.0, 3.0), 1.0),
    "brass": ("blotch", (0.72, 0.47, 0.16), (0.86, 0.60, 0.24), (0.22, 0.35), (3.0, 3.0), 1.0),
    "glass": ("blotch", (0.025, 0.04, 0.055), (0.05, 0.07, 0.09), (0.05, 0.10), (1.0, 1.0), 0.0),
    "glass_lit": ("blotch", (0.5, 0.28, 0.10), (0.6, 0.36, 0.15), (0.1, 0.2), (1.0, 1.0), 0.0),
    "glow": ("blotch", (0.9, 0.50, 0.16), (0.9, 0.60, 0.24), (0.6, 0.7), (1.0, 1.0), 0.0),
    "hill": ("blotch", (0.19, 0.27, 0.30), (0.30, 0.36, 0.34), (0.9, 0.95), (0.03, 0.03), 0.0),
    "far": ("blotch", (0.34, 0.34, 0.34), (0.48, 0.44, 0.40), (0.9, 0.95), (0.1, 0.1), 0.0),
    "water": ("water", (0.010, 0.045, 0.055), (0.015, 0.075, 0.080), (0.03, 0.05), (0.15, 0.15), 0.0),
}
EMISSION = {"glow": (2.6, (1.0, 0.55, 0.18)), "glass_lit": (1.1, (1.0, 0.58, 0.22))}


# --- materials and light ------------------------------------------------------------------------------------


def _node(tree, kind, inputs=None, **attributes):
    """Add a node; an input given as a socket is linked, anything else becomes its value."""
    node = tree.nodes.new(kind)
    for name, value in attributes.items():
        setattr(node, name, value)
    for key, value in (inputs or {}).items():
        if isinstance(value, bpy.types.NodeSocket):
            tree.links.new(value, node.inputs[key])
        else:
            node.inputs[key].default_value = value
    return node


def _math(tree, operation, *values, clamp=False):
    return _node(
        tree, "ShaderNodeMath", dict(enumerate(values)), operation=operation, use_clamp=clamp
    ).outputs[0]


def _mix(tree, factor, a, b, blend="MIX"):
    a, b = ((*c, 1.0) if isinstance(c, tuple) and len(c) == 3 else c for c in (a, b))
    return _node(tree, "ShaderNodeMix", {0: factor, 6: a, 7: b}, data_type="RGBA", blend_type=blend).outputs[
        2
    ]


def _range(tree, value, low, high, to_low, to_high):
    return _node(tree, "ShaderNodeMapRange", {0: value, 1: low, 2: high, 3: to_low, 4: to_high}).outputs[0]


def _material(name):
    """The named material of the table, made on first use."""
    made = bpy.data.materials.get(name)
    if made is not None:
        return made
    pattern, a, b, (rough_a, rough_b), (along, across), metallic = MATERIALS[name]
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    made.cycles.emission_sampling = "NONE"
    tree = made.node_tree
    shader = next(n for n in tree.nodes if n.type == "BSDF_PRINCIPLED")
    geometry = _node(tree, "ShaderNodeNewGeometry")
    uv = _node(tree, "ShaderNodeUVMap", uv_map="uv").outputs[0]
    tint = _node(tree, "ShaderNodeAttribute", attribute_name="tint").outputs["Fac"]
    u, v = _node(tree, "ShaderNodeSeparateXYZ", {0: uv}).outputs[:2]
    coordinate = _node(
        tree,
        "ShaderNodeCombineXYZ",
        {
            0: _math(tree, "MULTIPLY", u, along),
            1: _math(tree, "MULTIPLY", v, across),
            2: _math(tree, "MULTIPLY", tint, 31.0),
        },
    ).outputs[0]
    noise = _node(tree, "ShaderNodeTexNoise", {"Vector": coordinate, "Scale": 1.0, "Detail": 2.0}).outputs[0]
    grey = _range(tree, noise, 0.3, 0.7, 0.0, 1.0)
    bump, depth = grey, 0.012
    if pattern == "stripe":
        grey = _math(tree, "GREATER_THAN", _math(tree, "FRACT", _math(tree, "MULTIPLY", u, along)), 0.5)
    elif pattern == "brick":
        brick = _node(
            tree,
            "ShaderNodeTexBrick",
            {
                "Vector": uv,
                "Scale": along,
                "Mortar Size": 0.035,
                "Color1": (0.15,) * 3 + (1,),
                "Color2": (1.0,) * 3 + (1,),
            },
        )
        grey = _mix(tree, 0.35, brick.outputs[0], _mix(tree, grey, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)))
        bump, depth = grey, 0.02
    elif pattern == "cobble":
        cell = {"Vector": uv, "Scale": along, "Randomness": 0.8}
        edge = _node(tree, "ShaderNodeTexVoronoi", cell, feature="DISTANCE_TO_EDGE").outputs[0]
        shade = _node(tree, "ShaderNodeTexVoronoi", cell, feature="F1").outputs["Color"]
        dome = _range(tree, edge, 0.0, 0.22, 0.0, 1.0)
        shade = _node(tree, "ShaderNodeSeparateXYZ", {0: shade}).outputs[0]
        grey = _math(tree, "MULTIPLY", dome, _math(tree, "MULTIPLY_ADD", shade, 0.7, 0.3))
        bump, depth = dome, 0.035
    colour = _mix(tree, grey, a, b)
    shade = _math(tree, "MULTIPLY_ADD", tint, 0.5, 0.75)
    colour = _mix(
        tree,
        1.0,
        colour,
        _node(tree, "ShaderNodeCombineXYZ", {0: shade, 1: shade, 2: shade}).outputs[0],
        "MULTIPLY",
    )
    colour.node.clamp_result = True  # the tint lifts white cloth past a base colour of 1
    wet = noise
    if name in ("plank", "cobble"):  # puddles metres wide
        wet = _node(
            tree, "ShaderNodeTexNoise", {"Vector": geometry.outputs["Position"], "Scale": 0.45, "Detail": 1.0}
        ).outputs[0]
        dry = _range(tree, wet, 0.42, 0.56, 0.62, 1.0)
        colour = _mix(
            tree,
            1.0,
            colour,
            _node(tree, "ShaderNodeCombineXYZ", {0: dry, 1: dry, 2: dry}).outputs[0],
            "MULTIPLY",
        )
    rough = _range(tree, wet, 0.42, 0.60, rough_a, rough_b)
    shader.inputs["Metallic"].default_value = metallic
    tree.links.new(colour, shader.inputs["Base Color"])
    tree.links.new(rough, shader.inputs["Roughness"])
    if pattern == "water":
        ripple = _node(
            tree, "ShaderNodeTexNoise", {"Vector": geometry.outputs["Position"], "Scale": 0.9, "Detail": 1.0}
        ).outputs[0]
        bump, depth = ripple, 0.10
        shader.inputs["IOR"].default_value = 1.45
    normal = _node(tree, "ShaderNodeBump", {"Height": bump, "Distance": depth, "Strength": 0.6}).outputs[0]
    if pattern != "stripe" and name not in ("glass", "glass_lit", "glow"):
        tree.links.new(normal, shader.inputs["Normal"])
    if name in EMISSION:
        strength, light = EMISSION[name]
        shader.inputs["Emission Color"].default_value = (*light, 1.0)
        shader.inputs["Emission Strength"].default_value = strength
    else:  # the sampling-free share of the ambient light
        up = _node(tree, "ShaderNodeSeparateXYZ", {0: geometry.outputs["Normal"]}).outputs[2]
        ambient = _mix(tree, _range(tree, up, -1.0, 1.0, 0.0, 1.0), (0.20, 0.15, 0.11), (0.16, 0.21, 0.30))
        tree.links.new(_mix(tree, 1.0, colour, ambient, "MULTIPLY"), shader.inputs["Emission Color"])
        shader.inputs["Emission Strength"].default_value = (1.3 if name.startswith("sail") else 0.75) * (
            1.0 - metallic
        )
    return made


def add_light(rng):
    """One low warm sun, and a sky from a peach horizon to a blue zenith with wide soft clouds."""
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy, lamp.angle, lamp.color = 6.0, math.radians(0.35), (1.0, 0.70, 0.40)
    sun = bpy.data.objects.new("sun", lamp)
    sun.rotation_euler = SUN.to_track_quat("Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(sun)
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    bpy.context.scene.world = world
    tree = world.node_tree
    direction = _node(tree, "ShaderNodeTexCoord").outputs["Generated"]
    height = _node(tree, "ShaderNodeSeparateXYZ", {0: direction}).outputs[2]
    towards = _node(
        tree, "ShaderNodeVectorMath", {0: direction, 1: tuple(SUN)}, operation="DOT_PRODUCT"
    ).outputs["Value"]
    horizon = _mix(tree, _range(tree, towards, -0.6, 0.8, 0.0, 1.0), (0.72, 0.56, 0.52), (1.10, 0.60, 0.28))
    colour = _mix(tree, _range(tree, height, 0.0, 0.26, 0.0, 1.0), horizon, (0.44, 0.56, 0.72))
    colour = _mix(tree, _range(tree, height, 0.15, 0.70, 0.0, 1.0), colour, (0.09, 0.22, 0.54))
    flat = _node(
        tree, "ShaderNodeVectorMath", {0: direction, 1: (2.0, 2.0, 7.0)}, operation="MULTIPLY"
    ).outputs[0]
    flat = _node(
        tree, "ShaderNodeVectorMath", {0: flat, 1: (rng.uniform(0, 50), 0.0, 0.0)}, operation="ADD"
    ).outputs[0]
    cloud = _node(tree, "ShaderNodeTexNoise", {"Vector": flat, "Scale": 1.0, "Detail": 4.0}).outputs[0]
    colour = _mix(tree, _range(tree, cloud, 0.50, 0.70, 0.0, 0.8), colour, (1.15, 0.80, 0.58))
    halo = _math(tree, "POWER", _math(tree, "MAXIMUM", towards, 0.0), 14.0)
    colour = _mix(tree, halo, colour, (1.9, 1.25, 0.68))
    background = next(n for n in tree.nodes if n.type == "BACKGROUND")
    tree.links.new(colour, background.inputs[0])
    ray = _node(tree, "ShaderNodeLightPath")  # seen and reflected brighter than it lights: less to sample
    seen = _math(tree, "MAXIMUM", ray.outputs["Is Camera Ray"], ray.outputs["Is Glossy Ray"])
    tree.links.new(_range(tree, seen, 0.0, 1.0, 0.34, 0.66), background.inputs[1])


# --- geometry -----------------------------------------------------------------------------------------------


class Mesh:
    """Collects faces with material, metric uv and one tint a part; `at` places what is added next."""

    def __init__(self, rng, at=None):
        self.rng, self.at = rng, at or Matrix()
        self.points, self.faces, self.uv, self.slots, self.tints, self.smooth = [], [], [], [], [], []
        self.names = []

    def add(self, points, faces, uvs, material, tint=None, smooth=False):
        if material not in self.names:
            self.names.append(material)
        slot, base = self.names.index(material), len(self.points)
        tint = self.rng.random() if tint is None else tint
        self.points += [tuple(self.at @ Vector(p)) for p in points]
        for face, uv in zip(faces, uvs, strict=True):
            self.faces.append(tuple(base + i for i in face))
            self.uv += uv
            self.slots.append(slot)
            self.tints.append(tint)
            self.smooth.append(smooth)

    def box(self, centre, size, material, turn=None, tint=None):
        centre, turn, half = Vector(centre), turn or Matrix.Identity(3), [s / 2 for s in size]
        points = [
            centre + turn @ Vector((sx * half[0], sy * half[1], sz * half[2]))
            for sx in (-1, 1)
            for sy in (-1, 1)
            for sz in (-1, 1)
        ]
        faces = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
        axes = ((2, 1), (1, 2), (0, 2), (2, 0), (1, 0), (0, 1))
        shift, uvs = self.rng.uniform(0, 20), []
        for first, second in axes:
            du, dv = size[first], size[second]
            square = [(0, 0), (du, 0), (du, dv), (0, dv)]
            uvs.append([(shift + v, shift + u) if dv > du else (shift + u, shift + v) for u, v in square])
        self.add(points, faces, uvs, material, tint)

    def beam(self, a, b, width, height, material, tint=None):
        a, b = Vector(a), Vector(b)
        turn = (b - a).to_track_quat("X", "Z").to_matrix()
        self.box((a + b) / 2, ((b - a).length, width, height), material, turn, tint)

    def tube(self, path, radius, material, sides=6, tint=None, squash=1.0):
        """A round bar along `path`; `radius` is a number or one a point; ends are capped."""
        path = [Vector(p) for p in path]
        radii = radius if isinstance(radius, list) else [radius] * len(path)
        points, length, lengths = [], 0.0, []
        for i, p in enumerate(path):
            ahead = (path[min(i + 1, len(path) - 1)] - path[max(i - 1, 0)]).normalized()
            side = ahead.cross(Vector((0, 0, 1)) if abs(ahead.z) < 0.9 else Vector((1, 0, 0))).normalized()
            up = side.cross(ahead) * squash
            length += (p - path[i - 1]).length if i else 0.0
            lengths.append(length)
            for k in range(sides):
                angle = 2 * math.pi * k / sides
                points.append(p + (side * math.cos(angle) + up * math.sin(angle)) * radii[i])
        faces, uvs, shift = [], [], self.rng.uniform(0, 20)
        for i in range(len(path) - 1):
            for k in range(sides):
                n = (k + 1) % sides
                faces.append((i * sides + k, i * sides + n, (i + 1) * sides + n, (i + 1) * sides + k))
                around = [2 * math.pi * max(radii) * j / sides for j in (k, k + 1)]
                u0, u1 = shift + lengths[i], shift + lengths[i + 1]
                uvs.append([(u0, around[0]), (u0, around[1]), (u1, around[1]), (u1, around[0])])
        self.add(points, faces, uvs, material, tint, smooth=True)
        ring = [
            (
                math.cos(2 * math.pi * k / sides) * radii[-1] + shift,
                math.sin(2 * math.pi * k / sides) * radii[-1],
            )
            for k in range(sides)
        ]
        ends = [points[:sides][::-1], points[-sides:]]
        for end in ends:
            self.add(end, [tuple(range(sides))], [ring], material, tint)

    def rope(self, a, b, radius, sag=0.0, material="rope", parts=8):
        a, b = Vector(a), Vector(b)
        drop = Vector((0, 0, sag))
        parts = parts if sag else 1
        self.tube(
            [a.lerp(b, i / parts) - drop * 4 * (i / parts) * (1 - i / parts) for i in range(parts + 1)],
            radius,
            material,
            5,
        )

    def grid(self, shape, nu, nv, material, tint=None, flat=False):
        """A surface `shape(u, v) -> (point, uv)` over the unit square."""
        made = [[shape(i / nu, j / nv) for j in range(nv + 1)] for i in range(nu + 1)]
        points = [p for row in made for p, _ in row]
        faces, uvs, w = [], [], nv + 1
        for i in range(nu):
            for j in range(nv):
                corners = ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1))
                faces.append(tuple(a * w + b for a, b in corners))
                uvs.append([tuple(made[a][b][1]) for a, b in corners])
        self.add(points, faces, uvs, material, tint, smooth=not flat)

    def blob(self, centre, radii, material, tint=None, nu=10, nv=6):
        centre = Vector(centre)

        def shape(u, v):
            a, b = 2 * math.pi * u, math.pi * v
            p = Vector(
                (
                    math.sin(b) * math.cos(a) * radii[0],
                    math.sin(b) * math.sin(a) * radii[1],
                    math.cos(b) * radii[2],
                )
            )
            return centre + p, (u * 2 * radii[0], v * 2 * radii[2])

        self.grid(shape, nu, nv, material, tint)

    def object(self, name, parent=None, at=None):
        mesh = bpy.data.meshes.new(name)
        mesh.from_pydata(self.points, [], self.faces)
        mesh.uv_layers.new(name="uv").data.foreach_set("uv", [c for uv in self.uv for c in uv])
        mesh.attributes.new("tint", "FLOAT", "FACE").data.foreach_set("value", self.tints)
        mesh.polygons.foreach_set("material_index", self.slots)
        mesh.polygons.foreach_set("use_smooth", self.smooth)
        for material in self.names:
            mesh.materials.append(_material(material))
        mesh.update()
        return place(mesh, name, parent, at)


def place(mesh, name, parent=None, at=None):
    """An object of `mesh` (None: an empty), with its own object index."""
    made = bpy.data.objects.new(name, mesh)
    bpy.context.scene.collection.objects.link(made)
    made.pass_index = len(bpy.data.objects)
    made.parent = parent
    if at is not None:
        made.matrix_basis = at
    return made


def keyed(obj, frames, pose):
    """Key location and rotation on every frame; `pose(f)` gives (location, euler) or None to leave one."""
    for f in range(frames + 2):
        location, rotation = pose(f)
        if location is not None:
            obj.location = location
            obj.keyframe_insert("location", frame=f)
        if rotation is not None:
            obj.rotation_euler = rotation
            obj.keyframe_insert("rotation_euler", frame=f)


def waving(obj, frames, waves):
    """Travelling waves as shape keys: each is (displace(p) -> (vector, phase), radians a frame, start).

    vector*cos(phase - w f) is a cosine key and a sine key, so that motion vectors are exact.
    """
    rest = [v.co.copy() for v in obj.data.vertices]
    obj.shape_key_add(name="rest", from_mix=False)
    for number, (displace, speed, start) in enumerate(waves):
        moved = [displace(p) for p in rest]
        for name, turn in (("cos", math.cos), ("sin", math.sin)):
            key = obj.shape_key_add(name=f"{name}{number}", from_mix=False)
            key.slider_min, key.slider_max = -1.0, 1.0
            key.data.foreach_set(
                "co", [c for p, (d, a) in zip(rest, moved, strict=True) for c in p + d * turn(a)]
            )
            for f in range(frames + 2):
                key.value = turn(speed * f + start)
                key.keyframe_insert("value", frame=f)


def shift(x, y, z=0.0, turn=0.0):
    return Matrix.Translation((x, y, z)) @ Matrix.Rotation(turn, 4, "Z")
