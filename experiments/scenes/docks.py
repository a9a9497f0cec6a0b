"""The docks: a medieval quay with moored ships, half-timbered houses, a crane, stalls and glossy water.

Runs inside Blender (bpy 5.0), standard library otherwise. `build` fills an emptied file; the render core adds
passes and settings. x runs along the quay, water is y < 0, houses y > 10, z is up, metres. Every clip is another
town: placement, camera and phases come from (seed, split, clip) alone. Light is one small sun and a sky; the
part of the ambient light that needs no sampling is a little emission, base colour times a colour by normal, which
keeps the truth clean with few samples. Moving things are rigid key-frames or shape keys on frames 0..frames+1.
"""

import math
import random

import bpy
from mathutils import Euler, Matrix, Vector

SETTINGS = {
    "test_samples": 64,
    "train_samples": 16,
    "denoise": False,
    "max_bounces": 3,
    "diffuse_bounces": 0,
    "glossy_bounces": 2,
    "exposure": 1.0,
}

SUN = Vector((0.62, -0.70, 0.44)).normalized()  # towards the sun: over the water, low
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
    return _node(tree, "ShaderNodeMath", dict(enumerate(values)), operation=operation, use_clamp=clamp).outputs[0]


def _mix(tree, factor, a, b, blend="MIX"):
    a, b = (tuple(c) + (1.0,) if isinstance(c, tuple) and len(c) == 3 else c for c in (a, b))
    return _node(tree, "ShaderNodeMix", {0: factor, 6: a, 7: b}, data_type="RGBA", blend_type=blend).outputs[2]


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
        {0: _math(tree, "MULTIPLY", u, along), 1: _math(tree, "MULTIPLY", v, across), 2: _math(tree, "MULTIPLY", tint, 31.0)},
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
            {"Vector": uv, "Scale": along, "Mortar Size": 0.035, "Color1": (0.15,) * 3 + (1,), "Color2": (1.0,) * 3 + (1,)},
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
    colour = _mix(tree, 1.0, colour, _node(tree, "ShaderNodeCombineXYZ", {0: shade, 1: shade, 2: shade}).outputs[0], "MULTIPLY")
    wet = noise
    if name in ("plank", "cobble"):  # puddles metres wide
        wet = _node(tree, "ShaderNodeTexNoise", {"Vector": geometry.outputs["Position"], "Scale": 0.45, "Detail": 1.0}).outputs[0]
        dry = _range(tree, wet, 0.42, 0.56, 0.62, 1.0)
        colour = _mix(tree, 1.0, colour, _node(tree, "ShaderNodeCombineXYZ", {0: dry, 1: dry, 2: dry}).outputs[0], "MULTIPLY")
    rough = _range(tree, wet, 0.42, 0.60, rough_a, rough_b)
    shader.inputs["Metallic"].default_value = metallic
    tree.links.new(colour, shader.inputs["Base Color"])
    tree.links.new(rough, shader.inputs["Roughness"])
    if pattern == "water":
        ripple = _node(tree, "ShaderNodeTexNoise", {"Vector": geometry.outputs["Position"], "Scale": 0.9, "Detail": 1.0}).outputs[0]
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
        shader.inputs["Emission Strength"].default_value = 0.75 * (1.0 - metallic)
    return made


def _light(rng):
    """One low warm sun, and a sky from a peach horizon to a blue zenith with wide soft clouds."""
    lamp = bpy.data.lights.new("sun", "SUN")
    lamp.energy, lamp.angle, lamp.color = 5.2, math.radians(0.35), (1.0, 0.74, 0.46)
    sun = bpy.data.objects.new("sun", lamp)
    sun.rotation_euler = SUN.to_track_quat("Z", "Y").to_euler()
    bpy.context.scene.collection.objects.link(sun)
    world = bpy.data.worlds.new("sky")
    world.use_nodes = True
    bpy.context.scene.world = world
    tree = world.node_tree
    direction = _node(tree, "ShaderNodeTexCoord").outputs["Generated"]
    height = _node(tree, "ShaderNodeSeparateXYZ", {0: direction}).outputs[2]
    colour = _mix(tree, _range(tree, height, 0.0, 0.22, 0.0, 1.0), (0.98, 0.66, 0.42), (0.52, 0.62, 0.74))
    colour = _mix(tree, _range(tree, height, 0.15, 0.75, 0.0, 1.0), colour, (0.14, 0.29, 0.58))
    flat = _node(tree, "ShaderNodeVectorMath", {0: direction, 1: (2.0, 2.0, 7.0)}, operation="MULTIPLY").outputs[0]
    flat = _node(tree, "ShaderNodeVectorMath", {0: flat, 1: (rng.uniform(0, 50), 0.0, 0.0)}, operation="ADD").outputs[0]
    cloud = _node(tree, "ShaderNodeTexNoise", {"Vector": flat, "Scale": 1.0, "Detail": 4.0}).outputs[0]
    colour = _mix(tree, _range(tree, cloud, 0.50, 0.72, 0.0, 0.75), colour, (1.0, 0.80, 0.62))
    towards = _node(tree, "ShaderNodeVectorMath", {0: direction, 1: tuple(SUN)}, operation="DOT_PRODUCT").outputs["Value"]
    halo = _math(tree, "POWER", _math(tree, "MAXIMUM", towards, 0.0), 14.0)
    colour = _mix(tree, halo, colour, (1.9, 1.25, 0.68))
    background = next(n for n in tree.nodes if n.type == "BACKGROUND")
    tree.links.new(colour, background.inputs[0])
    background.inputs[1].default_value = 0.62


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
        points = [centre + turn @ Vector((sx * half[0], sy * half[1], sz * half[2])) for sx in (-1, 1) for sy in (-1, 1) for sz in (-1, 1)]
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
        ring = [(math.cos(2 * math.pi * k / sides) * radii[-1] + shift, math.sin(2 * math.pi * k / sides) * radii[-1]) for k in range(sides)]
        ends = [points[:sides][::-1], points[-sides:]]
        for end in ends:
            self.add(end, [tuple(range(sides))], [ring], material, tint)

    def rope(self, a, b, radius, sag=0.0, material="rope", parts=8):
        a, b = Vector(a), Vector(b)
        drop = Vector((0, 0, sag))
        parts = parts if sag else 1
        self.tube([a.lerp(b, i / parts) - drop * 4 * (i / parts) * (1 - i / parts) for i in range(parts + 1)], radius, material, 5)

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
            p = Vector((math.sin(b) * math.cos(a) * radii[0], math.sin(b) * math.sin(a) * radii[1], math.cos(b) * radii[2]))
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
            key.data.foreach_set("co", [c for p, (d, a) in zip(rest, moved, strict=True) for c in p + d * turn(a)])
            for f in range(frames + 2):
                key.value = turn(speed * f + start)
                key.keyframe_insert("value", frame=f)


def shift(x, y, z=0.0, turn=0.0):
    return Matrix.Translation((x, y, z)) @ Matrix.Rotation(turn, 4, "Z")


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
            m.blob((x + w * (k - 1.5) / 4, y - 0.22, z - h / 2 + 0.06), (0.17, 0.17, 0.14), "leaf" if k % 2 else rng.choice(["red", "yellow", "leaf"]), nu=6, nv=4)


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
                m.box((middle, y - 0.05, 1.1), (1.05, 0.10, 2.2), rng.choice(["crate", "green", "blue", "red"]))
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


def _town(rng, lane):
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
        m.box((x, -146, h / 2), (rng.uniform(5, 9), 5, h), rng.choice(["plaster_cream", "far", "plaster_rose"]))
        m.tube([(x, -146, h), (x, -146, h + 4)], [5.0, 0.1], "tile", 4)
    m.object("town")


# --- quay and things on it ----------------------------------------------------------------------------------


def _barrel(m, lying=False):
    keep = m.at
    if lying:
        m.at = keep @ Matrix.Translation((0, 0, 0.34)) @ Matrix.Rotation(math.pi / 2, 4, "X") @ Matrix.Translation((0, 0, -0.45))
    bulge = [0.27, 0.33, 0.35, 0.33, 0.27]
    m.tube([(0, 0, 0.9 * i / 4) for i in range(5)], bulge, "crate", 14)
    for z, r in ((0.1, 0.295), (0.3, 0.34), (0.6, 0.34), (0.8, 0.295)):
        m.tube([(0, 0, z - 0.03), (0, 0, z + 0.03)], r + 0.008, "iron", 14)
    m.at = keep


def _crate(m, s=0.9, goods=None):
    tint = m.rng.random()
    for k in range(4):
        z = s * (k + 0.5) / 4
        for side in (-1, 1):
            m.box((0, side * s * 0.47, z), (s, 0.04, s / 4 - 0.025), "crate", tint=tint + m.rng.uniform(-0.15, 0.15))
            m.box((side * s * 0.47, 0, z), (0.04, s, s / 4 - 0.025), "crate", tint=tint + m.rng.uniform(-0.15, 0.15))
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
            m.beam((-s * 0.45, side * s * 0.5, 0.1 * s), (s * 0.45, side * s * 0.5, 0.9 * s), 0.04, 0.11, "crate", tint=0.2)


def _basket(m, goods):
    m.tube([(0, 0, 0), (0, 0, 0.2), (0, 0, 0.4)], [0.28, 0.36, 0.42], "sack", 12)
    for k in range(9):
        a, r = k * 2.4, 0.28 if k else 0.0
        m.blob((r * math.cos(a), r * math.sin(a), 0.42 if k else 0.5), (0.13, 0.13, 0.12), goods, nu=8, nv=5)


def _pile_of_goods(m, rng):
    """One cluster about 1.6 m across."""
    base = m.at
    kind = rng.randrange(6)
    if kind == 0:
        for dx, dy in ((-0.4, 0), (0.38, 0.1), (0.0, 0.62)):
            m.at = base @ shift(dx, dy, 0, rng.uniform(0, 6))
            _barrel(m)
        m.at = base @ shift(0.0, 0.2, 0.9)
        _barrel(m)
    elif kind == 1:
        for dx, z in ((-0.55, 0), (0.5, 0), (0.0, 0.92)):
            m.at = base @ shift(dx, 0, z, rng.uniform(-0.25, 0.25))
            _crate(m, 0.92)
    elif kind == 2:
        for k in range(6):
            a = k * 1.2
            m.at = base
            r = 0.5 if k < 5 else 0.05
            m.blob((r * math.cos(a), r * math.sin(a), 0.28 if k < 5 else 0.62), (0.36, 0.30, 0.30), "sack")
            m.tube([(r * math.cos(a), r * math.sin(a), 0.5 if k < 5 else 0.85), (r * math.cos(a), r * math.sin(a), 0.72 if k < 5 else 1.08)], [0.07, 0.13], "sack", 7)
    elif kind == 3:
        for k in range(3):
            m.at = base @ shift((k - 1) * 0.9, rng.uniform(-0.2, 0.2), 0, rng.uniform(-0.2, 0.2))
            _crate(m, 0.7, rng.choice(["red", "yellow", "green"]))
    elif kind == 4:
        for k in range(3):
            m.at = base @ shift((k - 1) * 0.72, 0, 0)
            _barrel(m, lying=True)
        m.at = base @ shift(-0.36, 0, 0.6)
        _barrel(m, lying=True)
    else:
        for k in range(4):
            m.at = base @ shift((k % 2 - 0.5) * 0.9, (k // 2 - 0.5) * 0.9)
            _basket(m, rng.choice(["red", "yellow", "green", "white"]))
    m.at = base


def _coil(m):
    for k in range(4):
        r = 0.42 - 0.03 * k
        m.tube([(r * math.cos(a * 0.42), r * math.sin(a * 0.42), 0.05 + 0.09 * k) for a in range(16)], 0.05, "rope", 6)


def _lamp(m):
    m.box((0, 0, 1.6), (0.13, 0.13, 3.2), "timber")
    m.beam((0, 0, 3.1), (0, -0.8, 3.1), 0.08, 0.08, "timber")
    m.beam((0, 0, 2.6), (0, -0.5, 3.08), 0.06, 0.06, "timber")
    m.box((0, -0.75, 2.72), (0.22, 0.22, 0.34), "glow")
    for a in (-0.13, 0.13):
        for b in (-0.13, 0.13):
            m.box((a, -0.75 + b, 2.72), (0.045, 0.045, 0.4), "iron")
    m.tube([(0, -0.75, 2.92), (0, -0.75, 3.08)], [0.24, 0.03], "iron", 8)


def _stall(rng, x, y, frames, time):
    """A market stall with a striped awning that breathes."""
    m = Mesh(rng, shift(x, y))
    for a in (-1.5, 1.5):
        for b, h in ((-1.1, 2.15), (1.1, 2.7)):
            m.box((a, b, h / 2), (0.10, 0.10, h), "timber")
    m.box((0, -0.8, 0.9), (3.1, 0.9, 0.09), "crate")
    m.box((0, -1.2, 0.45), (3.0, 0.05, 0.85), rng.choice(["red", "blue", "green", "crate"]))
    for k in range(4):
        m.at = shift(x - 1.1 + 0.74 * k, y - 0.85, 0.95)
        _basket(m, rng.choice(["red", "yellow", "green", "white"])) if k % 2 else _crate(m, 0.6, rng.choice(["red", "yellow", "green"]))
    m.object("stall")
    cloth = Mesh(rng, shift(x, y))

    def shape(u, v):
        if v > 0.85:  # the hanging edge
            p = Vector(((u - 0.5) * 3.5, -1.55, 2.05 - (v - 0.85) * 2.4 * (0.8 + 0.2 * math.cos(u * 40))))
        else:
            p = Vector(((u - 0.5) * 3.5, 1.3 - v / 0.85 * 2.85, 2.78 - 0.73 * v / 0.85 - 0.10 * math.sin(math.pi * v / 0.85)))
        return p, (u * 3.5, v * 3.0)

    cloth.grid(shape, 28, 14, rng.choice(["awning_red", "awning_blue", "awning_green"]))
    start = rng.uniform(0, 6)
    waving(
        cloth.object("awning"),
        frames,
        [(lambda p: (Vector((0, 0.05 if p.z < 2.0 else 0.0, 0.035)), 2.2 * (p.x - x) + p.y), 0.30, start + time * 0.30)],
    )


def _quay(rng, pier_x):
    m = Mesh(rng)
    x = -64.0
    while x < 76:
        w = rng.uniform(0.21, 0.29)
        m.box((x + w / 2, 2.5 + rng.uniform(-0.04, 0.04), -0.05 + rng.uniform(-0.008, 0.008)), (w - 0.028, 5.1, 0.1), "plank")
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
                m.tube([(x + 0.2 * math.cos(a * 0.63), -0.3 + 0.2 * math.sin(a * 0.63), z) for a in range(11)], 0.045, "rope", 5)
        else:
            m.beam((x, -0.28, -2), (x + 2.4, -0.28, -0.4), 0.12, 0.12, "pile")
    for px in pier_x:
        y = 0.0
        while y > -13:
            w = rng.uniform(0.21, 0.29)
            m.box((px, y - w / 2, -0.12 + rng.uniform(-0.01, 0.01)), (2.5 + rng.uniform(-0.1, 0.1), w - 0.03, 0.09), "plank")
            y -= w
        for side in (-1, 1):
            m.box((px + side * 1.05, -6.4, -0.27), (0.2, 13, 0.2), "pile")
            for k in range(5):
                top = rng.uniform(0.6, 1.1)
                m.tube([(px + side * 1.28, -2.0 - 2.6 * k, -3), (px + side * 1.28, -2.0 - 2.6 * k, top)], 0.14, "pile", 8)
            for k in range(4):
                a, b = -2.0 - 2.6 * k, -4.6 - 2.6 * k
                m.rope((px + side * 1.28, a, 0.5), (px + side * 1.28, b, 0.5), 0.03, 0.16)
    m.object("quay")
    return posts


def _water(rng, frames, time):
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

    waves = [(wave(0.9, 1.3, 0.030), 0.20, 0.2 * time), (wave(-1.9, 1.1, 0.014), 0.27, 0.27 * time), (wave(0.3, -2.9, 0.009), 0.33, 0.33 * time)]
    waving(m.object("water"), frames, waves)


# --- ships --------------------------------------------------------------------------------------------------


def _hull(m, length, beam, side, paint, stripe):
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
                return Vector((x + rake, hand * half * (1 - 0.9 * k**2.4), top + (-0.9 - top) * k)), (x, k * 3)

            colour = stripe if j == 1 else paint
            m.grid(plank, 22, 1, colour, tint=0.2 + 0.6 * m.rng.random() if j != 1 else 0.5)
    for k, thick in ((0.0, 0.11), (0.25, 0.08), (0.48, 0.08)):
        for hand in (-1, 1):
            path = []
            for i in range(23):
                x, half, top = sheer(i / 22)
                path.append((x + 1.2 * (2 * i / 22 - 1) * (1 - k), hand * (half * (1 - 0.9 * k**2.4) + 0.03), top + (-0.9 - top) * k))
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
                m.box((x + (x1 - x0) / n / 2, hand * half, z + 0.32), ((x1 - x0) / n - 0.1, 0.07, 0.5), paint[k % 2])
        m.box(((x0 + x1) / 2, hand * half, z + 0.78), (x1 - x0 + 0.2, 0.14, 0.10), "timber")
    for x in (x0, x1):
        m.box((x, 0, z + 0.32), (0.07, half * 2, 0.5), paint[0])
        m.box((x, 0, z + 0.78), (0.14, half * 2 + 0.1, 0.10), "timber")


def _flag(rng, parent, at, length, height, frames, time, colour):
    """A flag flying to local +x from a hoist at x = 0; waves grow towards the fly."""
    m = Mesh(rng)
    m.grid(lambda u, v: (Vector((u * length, 0, -v * height * (1 - 0.45 * u))), (v * height * 2, u)), 16, 5, colour, tint=0.6)
    start = rng.uniform(0, 6)
    wind = [(lambda p: (Vector((0, 0.16 * p.x, 0.05 * p.x)), 4.5 * p.x / max(1.0, length * 0.7) + 0.6 * p.z), 0.75, start + 0.75 * time)]
    waving(m.object("flag", parent, at), frames, wind)


def _ship(rng, x, y, turn, frames, time, length, posts=()):
    """A moored ship that bobs and rolls, with masts, rigging, sails and flags."""
    beam, side = length * 0.30, 1.45 + 0.03 * length
    masts = [0.56] if length < 12.5 else [0.42, 0.72]
    m = Mesh(rng)
    paint = rng.choice(["hull_brown", "hull_dark", "hull_honey", "hull_brown"])
    accent = rng.choice([("red", "white"), ("blue", "yellow"), ("green", "yellow"), ("red", "yellow"), ("blue", "white")])
    sheer = _hull(m, length, beam, side, paint, accent[0])
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
        ends = [Vector((mx + 0.25 + s * span * math.sin(brace), s * span * math.cos(brace), z)) for s in (-1, 1)]
        m.tube([ends[0], (ends[0] + ends[1]) / 2, ends[1]], [0.07, 0.13, 0.07], "mast", 8)
        sails.append((mx, z, span, brace, ends, high))
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
        m.rope((mx, 0, side + high * 0.93), tip if number == len(masts) - 1 else ((masts[1] - 0.5) * length, 0, side + high * 0.5), 0.026, 0.1, "tar_rope")
        m.rope((mx, 0, side + high * 0.93), (-length / 2 - 0.2, 0, side + 2.0), 0.026, 0.15, "tar_rope")
    for _ in range(2):
        m.at = shift(rng.uniform(-0.15, 0.2) * length, rng.uniform(-0.2, 0.2) * beam, side - 0.55, rng.uniform(0, 6))
        rng.choice([_barrel, _crate])(m)
    m.at = Matrix()
    hull = m.object("ship")
    bob, roll, pitch = rng.uniform(0.05, 0.09), rng.uniform(0.030, 0.055), rng.uniform(0.006, 0.012)
    speed, start = rng.uniform(0.10, 0.15), rng.uniform(0, 6) + time

    def sway(f):
        return bob * math.sin(speed * f + start), roll * math.sin(0.83 * speed * f + 1.7 * start), pitch * math.sin(1.1 * speed * f + 0.6 * start)

    def pose(f):
        up, rx, ry = sway(f)
        return (x, y, WATER_Z + up), (rx, ry, turn)

    keyed(hull, frames, pose)
    for mx, z, span, brace, ends, high in sails:
        cloth = rng.choice(["sail", "sail_red", "sail_blue", "sail"])
        s = Mesh(rng)
        if rng.random() < 0.5:  # furled
            n = 18
            path = [ends[0].lerp(ends[1], 0.06 + 0.88 * i / n) - Vector((-0.05, 0, 0.20 + 0.05 * math.sin(math.pi * i / n))) for i in range(n + 1)]
            s.tube(path, [0.10 + 0.15 * math.sin(math.pi * i / n) ** 0.5 - (0.06 if i % 3 == 0 else 0.0) for i in range(n + 1)], "sail", 9)
            for i in range(3, n, 3):
                s.tube([path[i] - Vector((0, 0.03, 0)), path[i] + Vector((0, 0.03, 0))], 0.23, "rope", 9)
            s.object("furled sail", hull)
        else:  # hanging in a belly
            drop = high * rng.uniform(0.36, 0.46)
            across = (ends[1] - ends[0]).normalized()
            out = across.cross(Vector((0, 0, 1)))

            def shape(u, v, ends=ends, drop=drop, out=out):
                p = ends[0].lerp(ends[1], 0.05 + 0.9 * u * (1 - 0.08 * v) + 0.036 * v)
                belly = math.sin(math.pi * min(1.0, v * 0.9 + 0.05)) * (0.35 + 0.65 * math.sin(math.pi * u)) * 0.85
                foot = 0.35 * v * math.sin(math.pi * u)
                return p - Vector((0, 0, 0.12 + v * drop - foot)) + out * belly, ((u - 0.5) * 2 * span, v * drop)

            s.grid(shape, 22, 14, cloth, tint=0.6)
            made = s.object("sail", hull)

            def flutter(p, z=z, drop=drop, out=out):
                return out * (0.10 * max(0.0, (z - p.z) / drop)), 1.3 * p.y - 1.1 * p.z

            waving(made, frames, [(flutter, 0.42, rng.uniform(0, 6) + 0.42 * time)])
    for mx, z in top_flags:
        _flag(rng, hull, Matrix.Translation((mx, 0, z)) @ Matrix.Rotation(0.9 - turn, 4, "Z"), 2.0, 0.75, frames, time, rng.choice(accent))
    for post, t, hand in posts:  # mooring ropes follow the ship with the weight 0 at the post and 1 at the rail
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
            key.data.foreach_set("co", [c for p in rest for c in p + move * min(1.0, (p - post).length / span)])
            for f in range(frames + 2):
                key.value = sway(f)[index]
                key.keyframe_insert("value", frame=f)


# --- things that move ---------------------------------------------------------------------------------------


def _crane(rng, x, y, frames, time):
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
    _crate(load, 1.05)
    hung = load.object("hanging crate", jib)
    keyed(hung, frames, lambda f: (tip - Vector((0, 0, 0.3)), (0.11 * math.sin(0.21 * f + start), 0.16 * math.sin(0.18 * f + 1.3 * start), 0.03 * f)))


def _person(rng, name="person"):
    m = Mesh(rng)
    robe, over = rng.choice(["red", "blue", "green", "yellow", "sack", "hull_brown"]), rng.choice(["sack", "timber", "white", "red", "blue"])
    m.tube([(0, 0, 0.02), (0, 0, 0.55), (0, 0, 0.98), (0, 0, 1.28), (0, 0, 1.46)], [0.30, 0.25, 0.18, 0.23, 0.09], robe, 12)
    m.tube([(0, 0, 0.94), (0, 0, 1.02)], 0.195, "timber", 12)
    m.blob((0, 0, 1.60), (0.115, 0.115, 0.145), "skin")
    m.tube([(0, 0, 1.64), (0, 0, 1.67), (0, 0, 1.70), (0, 0, 1.84)], [0.22, 0.22, 0.13, 0.05], over, 12)
    for side in (-1, 1):
        m.tube([(0, side * 0.22, 1.38), (0.06, side * 0.30, 1.12), (0.26, side * 0.24, 0.98)], [0.085, 0.085, 0.06], over, 8)
        m.blob((0.30, side * 0.23, 0.98), (0.06, 0.06, 0.06), "skin", nu=6, nv=4)
    if rng.random() < 0.4:
        m.at = shift(0.42, 0, 0.72)
        _basket(m, rng.choice(["red", "yellow", "green"]))
    return m.object(name)


def _walk(obj, frames, x, y, heading, pace, phase):
    def pose(f):
        s = pace * (f - frames / 2)
        where = (x + s * math.cos(heading), y + s * math.sin(heading), 0.03 * abs(math.sin(0.42 * f + phase)))
        return where, (0.05 * math.sin(0.42 * f + phase), 0.03, heading + 0.06 * math.sin(0.42 * f + phase))

    keyed(obj, frames, pose)


def _cart(rng, x, y, heading, pace, frames):
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
    _basket(m, rng.choice(["red", "yellow", "green"]))
    cart = m.object("cart")
    keyed(cart, frames, lambda f: ((x + pace * (f - frames / 2) * math.cos(heading), y + pace * (f - frames / 2) * math.sin(heading), 0), (0, 0.02 * math.sin(0.9 * f), heading)))
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
    _walk(_person(rng, "carter"), frames, x - 2.15 * math.cos(heading), y - 2.15 * math.sin(heading), heading, pace, rng.uniform(0, 6))


def _rowboat(rng, x, y, heading, pace, frames, time):
    m = Mesh(rng)
    sheer = _hull(m, 4.2, 1.5, 0.42, rng.choice(["hull_honey", "hull_brown"]), rng.choice(["red", "blue", "white", "green"]))
    del sheer
    for dx in (-0.9, 0.5):
        m.box((dx, 0, 0.36), (0.3, 1.3, 0.06), "crate")
    boat = m.object("rowing boat")

    def pose(f):
        s = pace * (f - frames / 2) + 0.10 * math.sin(0.35 * f + time)
        return (x + s * math.cos(heading), y + s * math.sin(heading), WATER_Z + 0.05 + 0.03 * math.sin(0.3 * f + time)), (0.04 * math.sin(0.25 * f + time), 0.02 * math.sin(0.35 * f), heading)

    keyed(boat, frames, pose)
    rower = _person(rng, "rower")
    rower.parent = boat
    keyed(rower, frames, lambda f: ((0.35, 0, -0.25), (0, 0.25 * math.sin(0.35 * f + time), math.pi)))
    for side in (-1, 1):
        o = Mesh(rng)
        o.tube([(0, -side * 0.5, 0.12), (0, side * 1.9, -0.42)], 0.035, "mast", 6)
        o.beam((0, side * 1.8, -0.40), (0, side * 2.4, -0.53), 0.16, 0.04, "mast")
        oar = o.object("oar", boat)
        keyed(oar, frames, lambda f, side=side: ((-0.1, side * 0.72, 0.5), (side * 0.13 * math.cos(0.35 * f + time), 0, side * 0.5 * math.sin(0.35 * f + time))))


def _gull(rng, centre, frames):
    m = Mesh(rng)
    m.tube([(-0.42, 0, 0), (-0.2, 0, 0), (0.1, 0, 0.02), (0.3, 0, 0.04), (0.42, 0, 0.02)], [0.03, 0.08, 0.11, 0.07, 0.02], "white", 8)
    m.tube([(0.40, 0, 0.02), (0.50, 0, 0.0)], [0.025, 0.01], "yellow", 5)
    gull = m.object("gull")
    heading, pace, phase, beat = rng.uniform(0, 6.28), rng.uniform(0.14, 0.24), rng.uniform(0, 6), rng.uniform(0.7, 1.0)
    bend = rng.uniform(-0.02, 0.02)

    def pose(f):
        s, a = pace * (f - frames / 2), heading + bend * (f - frames / 2)
        return centre + Vector((s * math.cos(a), s * math.sin(a), 0.05 * math.sin(beat * f + phase))), (8 * bend, 0, a)

    keyed(gull, frames, pose)
    for side in (-1, 1):
        w = Mesh(rng)
        wing = [(0.14, 0, 0), (-0.12, 0, 0), (-0.10, side * 0.5, 0.07), (0.10, side * 0.5, 0.07), (-0.20, side * 0.98, 0.02), (-0.10, side * 0.98, 0.02)]
        w.add(wing, [(0, 1, 2, 3), (3, 2, 4, 5)], [[(0, 0)] * 4] * 2, "white", 0.7)
        keyed(w.object("wing", gull), frames, lambda f, side=side: ((0, side * 0.06, 0.05), (side * (0.15 + 0.55 * math.sin(beat * f + phase)), 0, 0)))


def _bunting(rng, a, b, frames, time):
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
        m.add([p - along * 0.2, p + along * 0.2, p - Vector((0, 0, 0.5))], [(0, 1, 2)], [[(0, 0), (1, 0), (0, 1)]], ("red", "yellow", "blue", "white")[k % 4], 0.6)
    wind = along.cross(Vector((0, 0, 1)))
    height = {i: (0.0 if i % 3 < 2 else 0.16) for i in range(3 * n)}
    order = iter(range(3 * n))
    waving(m.object("bunting"), frames, [(lambda p: (wind * height[next(order)], 1.7 * (p - a).dot(along)), 0.6, 0.6 * time)])


# --- the clip -----------------------------------------------------------------------------------------------


def _path(style, rng, split):
    """The camera's line start, end and its two targets for one style of shot; metres a frame are in the ends."""
    x = rng.uniform(-26, -6) if split == "train" else rng.uniform(12, 26)
    if style == "along":  # down the quay with the sun ahead
        a = Vector((x, rng.uniform(4.2, 5.2), rng.uniform(1.7, 2.3)))
        return a, a + Vector((2.2, -0.3, 0.1)), a + Vector((11, -4.6, 1.5)), a + Vector((13, -3.4, 1.7))
    if style == "masts":  # over the edge, panning past masts
        a = Vector((x, rng.uniform(2.4, 3.4), 1.8))
        return a, a + Vector((1.3, 0.2, 0.15)), a + Vector((7, -9, 3.2)), a + Vector((11.5, -8, 3.0))
    if style == "lane":  # out of a lane towards the ships
        a = Vector((x, 15.2, 1.75))
        return a, a + Vector((0.15, -2.6, 0.05)), a + Vector((-0.6, -10, 0.9)), a + Vector((1.5, -12, 1.1))
    if style == "water":  # from a boat, houses in the sun
        a = Vector((x, rng.uniform(-15.5, -14), rng.uniform(0.5, 1.2)))
        return a, a + Vector((2.0, 0.5, 0.1)), a + Vector((5, 14, 1.8)), a + Vector((9, 14, 2.0))
    if style == "back":  # away from the sun, backing out
        a = Vector((x + 8, rng.uniform(4.4, 5.4), rng.uniform(1.8, 2.4)))
        return a, a + Vector((1.7, 0.3, 0.25)), a + Vector((-11, -2.6, 1.2)), a + Vector((-10, -0.6, 1.4))
    a = Vector((x, 1.2, rng.uniform(2.0, 2.6)))  # "rise": up over the moorings
    return a, a + Vector((0.9, 0.6, 1.9)), a + Vector((9.5, -2.2, 0.2)), a + Vector((11, -0.4, 0.4))


STYLES = {
    "train": ("along", "water", "back", "masts", "lane", "rise"),
    "test": ("along", "water", "rise", "back", "lane", "masts"),
}


def _camera(rng, frames, line):
    a, b, look_a, look_b = line
    data = bpy.data.cameras.new("camera")
    data.lens, data.sensor_width, data.clip_end = rng.uniform(25, 29), 36.0, 2000.0
    camera = place(data, "camera")
    bpy.context.scene.camera = camera
    phase = rng.uniform(0, 6)

    def pose(f):
        t = f / frames
        eye = a.lerp(b, t) + Vector((0, 0, 0.015 * math.sin(0.5 * f + phase)))
        turn = (look_a.lerp(look_b, t) - eye).to_track_quat("-Z", "Y").to_euler()
        return eye, (turn.x, turn.y + 0.004 * math.sin(0.23 * f + phase), turn.z)

    keyed(camera, frames, pose)


def build(*, seed: int, split: str, clip: int, frames: int) -> None:
    """Build clip `clip` of `split` ("train" or "test") into an emptied file, keyed on frames 0..frames+1."""
    if split not in STYLES:
        raise ValueError(f"docks: split must be one of {sorted(STYLES)}, got {split!r}")
    bpy.context.preferences.edit.keyframe_new_interpolation_type = "LINEAR"
    rng = random.Random(f"docks/{seed}/{split}/{clip}")
    style, time = STYLES[split][clip % 6], rng.uniform(0, 100)
    line = _path(style, rng, split)
    eye, end = line[0], line[1]
    taken = [(eye.lerp(end, k / 4).x, eye.lerp(end, k / 4).y, 1.5) for k in range(5)]

    def free(x, y, r):
        return all(math.hypot(x - a, y - b) > r + c for a, b, c in taken)

    _light(rng)
    lane = eye.x + 0.07 if style == "lane" else eye.x + rng.uniform(12, 20)
    _town(rng, lane)
    pier_x, slots, x = [], [], eye.x - 27 + rng.uniform(-2, 2)
    while x < eye.x + 40:  # ships along the quay, now and then a pier between two
        length = rng.uniform(10.5, 14.5)
        slots.append((x + length / 2 + 1.6, length))
        x += length + 4.2
        if rng.random() < 0.6 and abs(x - eye.x) > 3:
            pier_x.append(x + 1.2)
            x += 3.4
    posts = _quay(rng, pier_x)
    _water(rng, frames, time)
    for x, length in slots:
        y = -length * 0.15 - 1.0
        if style == "water" and abs(x - eye.x) < 5 and eye.y > y - 6:
            continue
        turn = rng.choice((0.0, math.pi)) + rng.uniform(-0.03, 0.03)
        facing = 1 if math.cos(turn) > 0 else -1
        ropes = []
        for t in (0.10, 0.90):
            at = x + facing * (t - 0.5) * length
            post = min(posts, key=lambda p, at=at, t=t, facing=facing: abs(p - at - 2.2 * facing * (1 if t > 0.5 else -1)))
            ropes.append(((post, -0.3, 0.6), t, facing))
        _ship(rng, x, y, turn, frames, time, length, ropes)
    for k in range(4):  # ships at anchor
        x, y = eye.x - 22 + 17 * k + rng.uniform(-4, 4), rng.uniform(-34, -22)
        _ship(rng, x, y, rng.uniform(0, 6.28), frames, time, rng.uniform(10, 14))
    boat_x = eye.x + rng.uniform(7, 12)
    boat_y = -10.5 if style != "water" else -8.8
    _rowboat(rng, boat_x, boat_y, rng.choice((0.15, 3.0)), rng.uniform(0.07, 0.11), frames, time)
    _rowboat(rng, eye.x + rng.uniform(-14, -6), -11.5, rng.choice((-0.15, 3.3)), rng.uniform(0.06, 0.10), frames, time)

    back = -1 if style == "back" else 1
    movers = [(eye.x + back * rng.uniform(6.5, 9.0), 7.4), (eye.x + rng.uniform(12, 20), 6.4)]
    for (x, y), heading in zip(movers, (rng.choice((0.05, 3.2)), 3.1), strict=True):
        _cart(rng, x, y, heading, rng.uniform(0.045, 0.07), frames)
        taken += [(x + d, y, 0.8) for d in (-3, -2, -1, 0, 1, 2, 3)]
    for near in (eye.x + back * 10.5, eye.x - back * 14):
        if style == "lane":
            near += 3
        _crane(rng, near, 1.9, frames, time)
        taken.append((near, 1.9, 1.6))
    for k in range(4):
        x = eye.x - 20 + 11 * k + rng.uniform(-2, 2)
        y = 8.2
        if free(x, y, 1.9) and abs(x - lane) > 3:
            _stall(rng, x, y, frames, time)
            taken.append((x, y, 1.9))
    for _ in range(11):
        x, y = eye.x + rng.uniform(-18, 22), rng.uniform(2.6, 8.2)
        if free(x, y, 0.7):
            _walk(_person(rng), frames, x, y, rng.choice((0.0, 3.14)) + rng.uniform(-0.5, 0.5), rng.uniform(0.03, 0.055), rng.uniform(0, 6))
            taken.append((x, y, 0.9))
    goods = Mesh(rng)
    for _ in range(60):
        x, y = eye.x + rng.uniform(-26, 30), rng.choice((rng.uniform(0.9, 2.6), rng.uniform(0.9, 4.0), rng.uniform(8.4, 9.2)))
        if free(x, y, 0.95):
            goods.at = shift(x, y, 0, rng.uniform(0, 6.28))
            _coil(goods) if rng.random() < 0.2 else _pile_of_goods(goods, rng)
            taken.append((x, y, 0.95))
    for k in range(9):
        x = eye.x - 28 + 7.5 * k
        if free(x, 5.6, 0.3):
            goods.at = shift(x, 5.6)
            _lamp(goods)
    goods.object("goods")
    for k in range(5):
        x = eye.x - 18 + 9 * k + rng.uniform(-1, 1)
        pole = Mesh(rng, shift(x, 9.3))
        pole.tube([(0, 0, 0), (0, 0, 5.4)], [0.07, 0.04], "mast", 8)
        pole.object("pole")
        _flag(rng, None, shift(x, 9.3, 5.3, 0.9), 1.7, 0.8, frames, time, rng.choice(["red", "blue", "yellow", "awning_red", "awning_blue"]))
        if k < 4 and style != "lane":
            _bunting(rng, (x, 9.3, 4.3), (x + 9, 9.3, 4.4), frames, time)
    if style == "lane":
        for y in (10.4, 12.6):
            _bunting(rng, (lane - 1.6, y, 4.4), (lane + 1.6, y + 0.4, 4.6), frames, time)
    for _ in range(9):
        side = Vector((rng.uniform(-8, 16), rng.uniform(-15, 4), rng.uniform(4.5, 9.5)))
        if style == "water":
            side.y += 16
        _gull(rng, Vector((eye.x, 0, 0)) + side, frames)
    _camera(rng, frames, line)
