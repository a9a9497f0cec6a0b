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


def build(*, seed: int, split: str, clip: int, frames: int) -> None:
    import bpy

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
