"""The scene of tests/test_blender.py, with known geometry: a ground plane, a moving cube, two instances, sky.

The plane is z = 0 for |x|, |y| <= 6. The cube has half-size 0.8 and the transform `cube_pose(frame)`. The
camera pans and dollies; all is key-framed on every frame, with exact values. Runs inside Blender; the poses
are plain Python so that the tests import them without it.
"""

import math

SETTINGS = {
    "test_samples": 4,
    "train_samples": 2,
    "denoise": False,
    "max_bounces": 1,
    "diffuse_bounces": 1,
    "glossy_bounces": 1,
    "exposure": 0.5,
}
CUBE_HALF = 0.8
PLANE_HALF = 6.0


def cube_pose(frame: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Location and XYZ Euler angles."""
    return (-1.0 + 0.15 * frame, 0.2, 0.95), (0.1 * frame, 0.05 * frame, 0.2 + 0.12 * frame)


def camera_pose(frame: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    return (0.3 + 0.08 * frame, -7.0, 2.4 + 0.02 * frame), (
        math.radians(79),
        0.01 * frame,
        0.02 * frame - 0.1,
    )


MATERIALS = {  # object -> base colour, roughness, metallic that its material stands for
    "m0 none": ((0.8, 0.8, 0.8), 1.0, 0.0),
    "m1 reroute": ((0.1, 0.2, 0.3), 0.3, 0.7),
    "m2 mix": ((0.75, 0.0, 0.25), 0.85, 0.25),
    "m3 group": ((0.3, 0.6, 0.9), 0.35, 0.0),
    "m4 emission": ((1.0, 1.0, 1.0), 1.0, 0.0),
    "m5 add": ((0.5, 0.4, 0.3), 1.0, 0.0),
    "m6 linked factor": ((0.4, 0.5, 0.3), 0.55, 0.5),
    "m7 transparent": ((0.6, 0.1, 0.2), 1.0, 0.0),
    "m8 group input": ((0.9, 0.3, 0.1), 0.25, 1.0),
}


def build_materials() -> None:
    """A row of squares in front of a fixed camera, one for each kind of node tree."""
    import bpy

    scene = bpy.context.scene

    def tree_of(name):
        made = bpy.data.materials.new(name)
        made.use_nodes = True
        made.node_tree.nodes.clear()
        output = made.node_tree.nodes.new("ShaderNodeOutputMaterial")
        return made, made.node_tree, output.inputs["Surface"]

    def node(tree, kind, **inputs):
        made = tree.nodes.new(f"ShaderNode{kind}")
        for name, value in inputs.items():
            made.inputs[name.replace("_", " ")].default_value = value
        return made

    def join(tree, kind, a, b, factor=None):
        made = node(tree, kind)
        shaders = [s for s in made.inputs if s.type == "SHADER"]
        tree.links.new(a.outputs[0], shaders[0])
        tree.links.new(b.outputs[0], shaders[1])
        if isinstance(factor, float):
            made.inputs[0].default_value = factor
        elif factor is not None:
            tree.links.new(factor.outputs[0], made.inputs[0])
        return made

    def group(name, color_input):
        inner = bpy.data.node_groups.new(name, "ShaderNodeTree")
        inner.interface.new_socket(name="Shader", in_out="OUTPUT", socket_type="NodeSocketShader")
        out, enter = inner.nodes.new("NodeGroupOutput"), inner.nodes.new("NodeGroupInput")
        rough, metal = (0.25, 1.0) if color_input else (0.35, 0.0)
        bsdf = node(inner, "BsdfPrincipled", Base_Color=(0.3, 0.6, 0.9, 1), Roughness=rough, Metallic=metal)
        if color_input:
            inner.interface.new_socket(name="Paint", in_out="INPUT", socket_type="NodeSocketColor")
            inner.links.new(enter.outputs["Paint"], bsdf.inputs["Base Color"])
        inner.links.new(bsdf.outputs[0], out.inputs[0])
        return inner

    for i, name in enumerate(MATERIALS):
        bpy.ops.mesh.primitive_plane_add(size=0.9, location=(i + 0.5, 0.0, 0.0))
        bpy.context.object.name = name
        if name == "m0 none":
            continue
        made, tree, surface = tree_of(name)
        bpy.context.object.data.materials.append(made)
        if name == "m1 reroute":
            bsdf = node(tree, "BsdfPrincipled", Base_Color=(0.1, 0.2, 0.3, 1), Roughness=0.3, Metallic=0.7)
            last = tree.nodes.new("NodeReroute")
            tree.links.new(bsdf.outputs[0], last.inputs[0])
        elif name == "m2 mix":
            gloss = node(tree, "BsdfAnisotropic", Color=(0, 0, 1, 1), Roughness=0.4)
            last = join(tree, "MixShader", node(tree, "BsdfDiffuse", Color=(1, 0, 0, 1)), gloss, 0.25)
        elif name in ("m3 group", "m8 group input"):
            last = tree.nodes.new("ShaderNodeGroup")
            last.node_tree = group(name, name == "m8 group input")
            if name == "m8 group input":
                last.inputs["Paint"].default_value = (0.9, 0.3, 0.1, 1)
        elif name == "m4 emission":
            last = node(tree, "Emission", Color=(0.2, 0.5, 0.2, 1))
        elif name == "m5 add":
            paint = node(tree, "BsdfDiffuse", Color=(0.5, 0.4, 0.3, 1))
            last = join(tree, "AddShader", node(tree, "Emission"), paint)
        elif name == "m6 linked factor":
            factor = node(tree, "Value")
            factor.outputs[0].default_value = 0.5
            a = node(tree, "BsdfPrincipled", Base_Color=(0.2, 0.4, 0.1, 1), Roughness=0.3, Metallic=1.0)
            b = node(tree, "BsdfPrincipled", Base_Color=(0.6, 0.6, 0.5, 1), Roughness=0.8, Metallic=0.0)
            last = join(tree, "MixShader", a, b, factor)
        else:
            paint = node(tree, "BsdfDiffuse", Color=(0.6, 0.1, 0.2, 1))
            last = join(tree, "MixShader", node(tree, "BsdfTransparent"), paint, 0.8)
        tree.links.new(last.outputs[0], surface)
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location = (len(MATERIALS) / 2, 0.0, 14.0)
    scene.collection.objects.link(camera)
    scene.camera = camera


def build(*, seed: int, split: str, clip: int, frames: int) -> None:
    import bpy

    if split == "materials":
        build_materials()
        return
    scene = bpy.context.scene

    def material(name, textured, roughness, metallic):
        made = bpy.data.materials.new(name)
        made.use_nodes = True
        bsdf = next(n for n in made.node_tree.nodes if n.type == "BSDF_PRINCIPLED")
        bsdf.inputs["Roughness"].default_value = roughness
        bsdf.inputs["Metallic"].default_value = metallic
        bsdf.inputs["Base Color"].default_value = (0.2, 0.4, 0.6, 1.0)
        if textured:
            checker = made.node_tree.nodes.new("ShaderNodeTexChecker")
            checker.inputs["Scale"].default_value = 3.0
            made.node_tree.links.new(checker.outputs["Color"], bsdf.inputs["Base Color"])
        return made

    def animate(obj, pose):
        obj.rotation_mode = "XYZ"
        for frame in range(frames + 2):
            obj.location, obj.rotation_euler = pose(frame)
            obj.keyframe_insert("location", frame=frame)
            obj.keyframe_insert("rotation_euler", frame=frame)

    bpy.ops.mesh.primitive_plane_add(size=2 * PLANE_HALF)
    plane = bpy.context.object
    plane.name = "plane"
    plane.data.materials.append(material("ground", True, 0.75, 0.0))
    bpy.ops.mesh.primitive_cube_add(size=2 * CUBE_HALF)
    cube = bpy.context.object
    cube.name = "cube"
    cube.data.materials.append(material("paint", False, 0.25, 1.0))
    animate(cube, cube_pose)

    bpy.ops.mesh.primitive_cube_add(size=0.5)
    post = bpy.context.object
    post.name = "post"
    bpy.context.scene.collection.objects.unlink(post)
    group = bpy.data.collections.new("posts")
    group.objects.link(post)
    for i, place in enumerate(((2.2, 0.5, 0.25), (2.9, -0.5, 0.25))):
        empty = bpy.data.objects.new(f"post.{i}", None)
        empty.instance_type, empty.instance_collection, empty.location = "COLLECTION", group, place
        scene.collection.objects.link(empty)

    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy, sun.data.angle = 3.0, 0.0
    sun.rotation_euler = (0.5 + 0.2 * clip, 0.3, 0.0)
    scene.collection.objects.link(sun)
    scene.world = bpy.data.worlds.new("sky")
    scene.world.use_nodes = True
    background = next(n for n in scene.world.node_tree.nodes if n.type == "BACKGROUND")
    background.inputs["Color"].default_value = (0.3, 0.5, 0.9, 1.0)

    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.lens, camera.data.shift_x, camera.data.shift_y = 30.0, 0.05, -0.04
    scene.collection.objects.link(camera)
    animate(camera, camera_pose)
    scene.camera = camera
    if split == "zoom":
        camera.animation_data_clear()
        camera.location, camera.rotation_euler = camera_pose(0)
        for frame in range(frames + 2):
            camera.data.lens = 30 + 3 * frame
            camera.data.keyframe_insert("lens", frame=frame)
    if split == "orthographic":
        camera.data.type = "ORTHO"
    if split == "cut":
        other = bpy.data.objects.new("other", bpy.data.cameras.new("other"))
        other.location, other.rotation_euler = (0.0, -9.0, 3.0), (math.radians(75), 0.0, 0.0)
        scene.collection.objects.link(other)
        for frame, bound in ((1, camera), (3, other)):
            scene.timeline_markers.new(f"cut {frame}", frame=frame).camera = bound
