"""Helpers shared by the procedural Blender scenes (run inside Blender: `bpy`, `bmesh`, `mathutils`, stdlib).

World space is Blender's: metres, z up. Everything that moves is keyed on every frame 0..frames+1 with linear
interpolation, so that the previous and the next frame of each rendered frame 1..frames are exact.
Materials are one Principled BSDF each, opaque, without volumes: a G-buffer describes them fully.
"""

import math
import random
from collections.abc import Callable, Iterable, Sequence

import bpy
from mathutils import Euler, Matrix, Quaternion, Vector

Color = Sequence[float]


def reset() -> bpy.types.Scene:
    """Empty the file and return its scene: no objects, no world, Cycles on the CPU, no motion blur."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.render.use_motion_blur = False
    return scene


def generator(*key: object) -> random.Random:
    """A random generator that depends on `key` alone (strings hash by content, not by process)."""
    return random.Random("/".join(str(part) for part in key))


# --- materials ------------------------------------------------------------------------------------------


def material(
    name: str,
    base_color: Color = (0.8, 0.8, 0.8),
    roughness: float = 0.7,
    metallic: float = 0.0,
    emission: Color | None = None,
    emission_strength: float = 1.0,
    specular: float = 0.5,
) -> bpy.types.Material:
    """A material of one Principled BSDF; colours are linear RGB. `Nodes(mat)` adds textures to it."""
    mat = bpy.data.materials.new(name)
    if not mat.use_nodes:
        mat.use_nodes = True
    bsdf = principled(mat)
    bsdf.inputs["Base Color"].default_value = (*base_color[:3], 1.0)
    bsdf.inputs["Roughness"].default_value = roughness
    bsdf.inputs["Metallic"].default_value = metallic
    bsdf.inputs["Specular IOR Level"].default_value = specular
    if emission is not None:
        bsdf.inputs["Emission Color"].default_value = (*emission[:3], 1.0)
        bsdf.inputs["Emission Strength"].default_value = emission_strength
    return mat


def principled(mat: bpy.types.Material) -> bpy.types.Node:
    """The Principled BSDF of `mat`."""
    return next(node for node in mat.node_tree.nodes if node.type == "BSDF_PRINCIPLED")


class Nodes:
    """Short names for building a material's texture nodes.

    Methods return output sockets; an argument is a socket or a plain value (number, vector, colour).
    """

    def __init__(self, mat: bpy.types.Material):
        self.tree = mat.node_tree
        self.bsdf = principled(mat)

    def node(self, kind: str, inputs: dict | None = None, **settings: object) -> bpy.types.Node:
        """A node of type `kind`; `inputs` by socket name or number, `settings` are node properties."""
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        for key, value in (inputs or {}).items():
            self.connect(value, node.inputs[key])
        return node

    def connect(self, value: object, socket: bpy.types.NodeSocket) -> None:
        """Link a socket, or set a plain value (an RGB triple gains alpha 1 where the socket has four)."""
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
            return
        if socket.type == "RGBA" and not isinstance(value, int | float) and len(value) == 3:
            value = (*value, 1.0)
        socket.default_value = value

    def set(self, name: str, value: object) -> None:
        """Connect an input of the Principled BSDF ("Base Color", "Roughness", "Metallic", "Normal" ...)."""
        self.connect(value, self.bsdf.inputs[name])

    def coordinates(self, space: str = "Object") -> bpy.types.NodeSocket:
        """Texture coordinates: "Object", "Generated", "UV"."""
        return self.node("ShaderNodeTexCoord").outputs[space]

    def world_position(self) -> bpy.types.NodeSocket:
        """World position: continuous over static objects. Not for what moves (the texture would swim)."""
        return self.node("ShaderNodeNewGeometry").outputs["Position"]

    def mapping(self, vector: object, scale: Color = (1, 1, 1), location: Color = (0, 0, 0)):
        """vector * scale + location."""
        inputs = {"Vector": vector, "Scale": scale, "Location": location}
        return self.node("ShaderNodeMapping", inputs).outputs[0]

    def noise(
        self, vector: object, scale: float, detail: float = 2.0, roughness: float = 0.5, distort: float = 0
    ):
        """Fractal noise, about 0.2..0.8; the finest feature is about 1 / (scale * 2**detail) metres."""
        inputs = {"Vector": vector, "Scale": scale, "Detail": detail, "Roughness": roughness}
        return self.node("ShaderNodeTexNoise", {**inputs, "Distortion": distort}).outputs[0]

    def voronoi(self, vector: object, scale: float, feature: str = "F1", output: str = "Distance"):
        """Cell texture: output "Distance" or "Color" (one random colour a cell)."""
        node = self.node("ShaderNodeTexVoronoi", {"Vector": vector, "Scale": scale}, feature=feature)
        return node.outputs[output]

    def object_random(self) -> bpy.types.NodeSocket:
        """A random number in 0..1, one per object (instance)."""
        return self.node("ShaderNodeObjectInfo").outputs["Random"]

    def ramp(self, value: object, stops: Iterable[tuple[float, Color]], interpolation: str = "LINEAR"):
        """Colour ramp: stops of (position, linear RGB)."""
        node = self.node("ShaderNodeValToRGB", {0: value})
        node.color_ramp.interpolation = interpolation
        elements = node.color_ramp.elements
        for number, (position, color) in enumerate(stops):
            element = elements[number] if number < 2 else elements.new(position)
            element.position = position
            element.color = (*color[:3], 1.0)
        return node.outputs["Color"]

    def math(self, operation: str, *values: object, clamp: bool = False) -> bpy.types.NodeSocket:
        """Scalar maths: "ADD", "MULTIPLY", "POWER", "GREATER_THAN", ..."""
        inputs = dict(enumerate(values))
        return self.node("ShaderNodeMath", inputs, operation=operation, use_clamp=clamp).outputs[0]

    def step(self, value: object, low: float, high: float, out_low: float = 0.0, out_high: float = 1.0):
        """Smooth step of a scalar from `low`..`high` to `out_low`..`out_high`."""
        inputs = {"Value": value, "From Min": low, "From Max": high, "To Min": out_low, "To Max": out_high}
        return self.node("ShaderNodeMapRange", inputs, interpolation_type="SMOOTHSTEP").outputs["Result"]

    def mix(self, factor: object, a: object, b: object, blend: str = "MIX") -> bpy.types.NodeSocket:
        """Mix two colours."""
        node = self.node("ShaderNodeMix", data_type="RGBA", blend_type=blend)
        for number, value in ((0, factor), (6, a), (7, b)):
            self.connect(value, node.inputs[number])
        return node.outputs[2]

    def bump(self, height: object, distance: float, strength: float = 1.0) -> bpy.types.NodeSocket:
        """Bump normal; the height is multiplied by `distance` metres."""
        inputs = {"Height": height, "Distance": distance, "Strength": strength}
        return self.node("ShaderNodeBump", inputs).outputs[0]


# --- meshes and objects ---------------------------------------------------------------------------------


def mesh(
    name: str,
    vertices: Sequence[Sequence[float]],
    faces: Sequence[Sequence[int]],
    materials: bpy.types.Material | Sequence[bpy.types.Material],
    smooth: bool = False,
    material_of_face: Sequence[int] | None = None,
) -> bpy.types.Mesh:
    """A mesh from vertices and faces, with one material or several chosen by `material_of_face`."""
    data = bpy.data.meshes.new(name)
    data.from_pydata([tuple(vertex) for vertex in vertices], [], [tuple(face) for face in faces])
    for mat in [materials] if isinstance(materials, bpy.types.Material) else materials:
        data.materials.append(mat)
    data.polygons.foreach_set("use_smooth", [smooth] * len(data.polygons))
    if material_of_face is not None:
        data.polygons.foreach_set("material_index", list(material_of_face))
    data.update()
    return data


def add(
    data: bpy.types.ID | None,
    name: str = "",
    location: Sequence[float] = (0, 0, 0),
    rotation: Sequence[float] = (0, 0, 0),
    scale: Sequence[float] | float = 1.0,
    parent: bpy.types.Object | None = None,
) -> bpy.types.Object:
    """An object of `data` (mesh, light, camera; None: an empty); Euler rotation in radians.

    Objects that share a mesh share its memory in Cycles too.
    """
    ob = bpy.data.objects.new(name or (data.name if data else "empty"), data)
    ob.location = location
    ob.rotation_euler = rotation
    ob.scale = (scale,) * 3 if isinstance(scale, int | float) else scale
    ob.parent = parent
    bpy.context.scene.collection.objects.link(ob)
    return ob


def box_mesh(name: str, size: Sequence[float], mat: bpy.types.Material) -> bpy.types.Mesh:
    """A box centred at the origin with edge lengths `size`."""
    x, y, z = (length / 2 for length in size)
    vertices = [(i, j, k) for i in (-x, x) for j in (-y, y) for k in (-z, z)]
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return mesh(name, vertices, faces, mat)


def tube_mesh(
    name: str,
    points: Sequence[Sequence[float]],
    radii: Sequence[float] | float,
    mat: bpy.types.Material,
    sides: int = 12,
    caps: bool = True,
    relief: Callable[[float, float], float] | None = None,
    smooth: bool = True,
) -> bpy.types.Mesh:
    """A round tube along `points`; `relief(angle, index)` multiplies the radius (bark, dents)."""
    centres = [Vector(point) for point in points]
    widths = [radii] * len(centres) if isinstance(radii, int | float) else list(radii)
    vertices: list[Vector] = []
    faces: list[tuple[int, ...]] = []
    frame = None
    for number, centre in enumerate(centres):
        tangent = (centres[min(number + 1, len(centres) - 1)] - centres[max(number - 1, 0)]).normalized()
        # Parallel transport: the ring does not twist along the curve.
        turn = (
            tangent.to_track_quat("Z", "Y")
            if frame is None
            else frame[0].rotation_difference(tangent) @ frame[1]
        )
        frame = (tangent, turn)
        for side in range(sides):
            angle = math.tau * side / sides
            radius = widths[number] * (relief(angle, number) if relief else 1.0)
            vertices.append(centre + turn @ Vector((radius * math.cos(angle), radius * math.sin(angle), 0)))
    for ring in range(len(centres) - 1):
        for side in range(sides):
            a, b = ring * sides + side, ring * sides + (side + 1) % sides
            faces.append((a, b, b + sides, a + sides))
    if caps:
        last = (len(centres) - 1) * sides
        faces += [tuple(reversed(range(sides))), tuple(range(last, last + sides))]
    return mesh(name, vertices, faces, mat, smooth=smooth)


def sun(
    direction: Sequence[float], color: Color, strength: float, angle_deg: float = 0.2
) -> bpy.types.Object:
    """Sun light that shines along `direction`; `angle_deg` is its apparent diameter (small: hard shadows)."""
    light = bpy.data.lights.new("sun", "SUN")
    light.color, light.energy, light.angle = color[:3], strength, math.radians(angle_deg)
    ob = add(light)
    ob.rotation_euler = Vector(direction).to_track_quat("-Z", "Y").to_euler()
    return ob


def lamp(
    location: Sequence[float],
    color: Color,
    watts: float,
    radius: float = 0.02,
    spot_deg: float | None = None,
    target: Sequence[float] | None = None,
) -> bpy.types.Object:
    """Point lamp, or a spot lamp of full cone `spot_deg` aimed at `target`."""
    light = bpy.data.lights.new("lamp", "SPOT" if spot_deg else "POINT")
    light.color, light.energy, light.shadow_soft_size = color[:3], watts, radius
    ob = add(light, location=location)
    if spot_deg:
        light.spot_size = math.radians(spot_deg)
    if target is not None:
        ob.rotation_euler = (Vector(target) - Vector(location)).to_track_quat("-Z", "Y").to_euler()
    return ob


def sky(
    stops: Iterable[tuple[float, Color]], strength: float = 1.0, light: Color | None = None
) -> bpy.types.World:
    """World with a vertical gradient: stops of (sine of the elevation in -1..1, linear RGB).

    With `light`, the camera and reflections see the gradient; diffuse surfaces get the colour `light`.
    """
    world = bpy.data.worlds.new("sky")
    bpy.context.scene.world = world
    if not world.use_nodes:
        world.use_nodes = True
    tree = world.node_tree
    tree.nodes.clear()
    new, link = tree.nodes.new, tree.links.new
    up, ramp = new("ShaderNodeSeparateXYZ"), new("ShaderNodeValToRGB")
    scaled = new("ShaderNodeMapRange")
    scaled.inputs["From Min"].default_value = -1.0
    back, out = new("ShaderNodeBackground"), new("ShaderNodeOutputWorld")
    link(new("ShaderNodeTexCoord").outputs["Generated"], up.inputs[0])
    link(up.outputs[2], scaled.inputs["Value"])
    link(scaled.outputs["Result"], ramp.inputs[0])
    for number, (height, color) in enumerate(stops):
        elements = ramp.color_ramp.elements
        element = elements[number] if number < 2 else elements.new((height + 1) / 2)
        element.position, element.color = (height + 1) / 2, (*color[:3], 1.0)
    link(ramp.outputs["Color"], back.inputs["Color"])
    back.inputs["Strength"].default_value = strength
    shader = back.outputs[0]
    if light is not None:
        flat, mix = new("ShaderNodeBackground"), new("ShaderNodeMixShader")
        flat.inputs["Color"].default_value = (*light[:3], 1.0)
        rays, seen = new("ShaderNodeLightPath").outputs, new("ShaderNodeMath")
        seen.operation = "MAXIMUM"
        link(rays["Is Camera Ray"], seen.inputs[0])
        link(rays["Is Glossy Ray"], seen.inputs[1])
        link(seen.outputs[0], mix.inputs[0])
        link(flat.outputs[0], mix.inputs[1])
        link(shader, mix.inputs[2])
        shader = mix.outputs[0]
    link(shader, out.inputs["Surface"])
    return world


# --- animation ------------------------------------------------------------------------------------------


def key_matrices(ob: bpy.types.Object, matrices: Sequence[Matrix], first: int = 0) -> None:
    """Key location, rotation (quaternion) and scale: `matrices[i]` at frame `first + i`, linear between.

    For a child the matrices are relative to its parent.
    """
    ob.rotation_mode = "QUATERNION"
    locations, rotations, scales = [], [], []
    for matrix in matrices:
        location, rotation, scale = matrix.decompose()
        if rotations and rotations[-1].dot(rotation) < 0:
            rotation = -rotation  # the short way round between keys
        locations.append(location)
        rotations.append(rotation)
        scales.append(scale)
    ob.location, ob.rotation_quaternion, ob.scale = locations[0], rotations[0], scales[0]
    for path, values in (("location", locations), ("rotation_quaternion", rotations), ("scale", scales)):
        if any((Vector(value) - Vector(values[0])).length > 1e-7 for value in values):
            key_values(ob, path, values, first)


def key_motion(ob: bpy.types.Object, frames: int, matrix_at: Callable[[int], Matrix]) -> None:
    """Key `ob` with `matrix_at(frame)` on every frame 0..frames+1."""
    key_matrices(ob, [matrix_at(frame) for frame in range(frames + 2)])


def key_values(
    ob: bpy.types.ID, path: str, values: Sequence[Sequence[float] | float], first: int = 0
) -> None:
    """Key the property `path` of `ob` (a vector or a scalar) on consecutive frames, linear between."""
    if ob.animation_data is None:
        ob.animation_data_create()
    animation = ob.animation_data
    if animation.action is None:
        animation.action = bpy.data.actions.new(ob.name)
        animation.action_slot = animation.action.slots.new(ob.id_type, ob.name)
        animation.action.layers.new("base").strips.new(type="KEYFRAME")
    bag = animation.action.layers[0].strips[0].channelbag(animation.action_slot, ensure=True)
    scalar = isinstance(values[0], int | float)
    for index in range(1 if scalar else len(values[0])):
        curve = bag.fcurves.new(path, index=index)
        curve.keyframe_points.add(len(values))
        flat: list[float] = []
        for number, value in enumerate(values):
            flat += [first + number, value if scalar else value[index]]
        curve.keyframe_points.foreach_set("co", flat)
        curve.keyframe_points.foreach_set("interpolation", [1] * len(values))  # linear
        curve.update()


def place(location: Sequence[float], rotation: Sequence[float] = (0, 0, 0), scale: float = 1.0) -> Matrix:
    """Matrix of a location, an Euler rotation (radians, XYZ) and a scale."""
    return Matrix.LocRotScale(Vector(location), Euler(rotation), Vector((scale,) * 3))


def camera(fov_deg: float = 60.0, near: float = 0.05, far: float = 500.0) -> bpy.types.Object:
    """The scene's camera with a constant horizontal field of view."""
    data = bpy.data.cameras.new("camera")
    data.sensor_fit = "HORIZONTAL"
    data.lens_unit = "FOV"
    data.angle = math.radians(fov_deg)
    data.clip_start, data.clip_end = near, far
    data.dof.use_dof = False
    ob = add(data)
    bpy.context.scene.camera = ob
    return ob


def look_at(position: Sequence[float], target: Sequence[float], roll: float = 0.0) -> Matrix:
    """World matrix of a camera at `position` that looks at `target`, z up, rolled by `roll` radians."""
    rotation = (Vector(target) - Vector(position)).to_track_quat("-Z", "Y")
    return Matrix.LocRotScale(Vector(position), rotation @ Quaternion((0, 0, 1), roll), None)


def look_at_path(
    ob: bpy.types.Object, points: Sequence[Sequence[float]], targets: Sequence[Sequence[float]], frames: int
) -> None:
    """Key the camera (or any -Z looking object) along smooth curves through `points` and `targets`.

    Both are Catmull-Rom curves run through from frame 0 to frame frames+1.
    """
    last = frames + 1
    key_motion(ob, frames, lambda f: look_at(curve_point(points, f / last), curve_point(targets, f / last)))


def curve_point(points: Sequence[Sequence[float]], t: float) -> Vector:
    """Point at t in 0..1 on the Catmull-Rom curve through `points` (any number of them, at least one)."""
    if len(points) == 1:
        return Vector(points[0])
    position = min(max(t, 0.0), 1.0) * (len(points) - 1)
    number = min(int(position), len(points) - 2)
    t = position - number
    p1, p2 = Vector(points[number]), Vector(points[number + 1])
    p0 = Vector(points[number - 1]) if number else 2 * p1 - p2
    p3 = Vector(points[number + 2]) if number + 2 < len(points) else 2 * p2 - p1
    return 0.5 * (
        2 * p1 + (p2 - p0) * t + (2 * p0 - 5 * p1 + 4 * p2 - p3) * t * t + (3 * p1 - p0 - 3 * p2 + p3) * t**3
    )
