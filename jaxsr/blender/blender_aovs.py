"""Runs inside Blender: gives every material the outputs "base_color", "roughness", "metallic", "instance".

Imports bpy and nothing of jaxsr. Shading is not changed: nodes are only added. The surface is followed from
the active material output through reroutes, node groups, mix and add shaders down to the BSDFs, and what
feeds their inputs is connected to (or its constant copied into) AOV output nodes. Not described: volumes,
geometry that Geometry Nodes creates without a material, closures made by scripts (OSL).
"""

from typing import Any, NamedTuple

import bpy

COLOR_AOV, VALUE_AOVS = "base_color", ("roughness", "metallic")
INSTANCE_AOV = "instance"
RENDERED_TYPES = ("MESH", "CURVE", "SURFACE", "META", "FONT", "CURVES", "POINTCLOUD")

# Shader node type -> (colour input, roughness input or constant, metallic input or constant).
_BSDFS = {
    "BSDF_PRINCIPLED": ("Base Color", "Roughness", "Metallic"),
    "BSDF_DIFFUSE": ("Color", 1.0, 0.0),
    "BSDF_GLOSSY": ("Color", "Roughness", 1.0),
    "BSDF_ANISOTROPIC": ("Color", "Roughness", 1.0),
    "BSDF_METALLIC": ("Base Color", "Roughness", 1.0),
    "BSDF_GLASS": ("Color", "Roughness", 0.0),
    "BSDF_REFRACTION": ("Color", "Roughness", 0.0),
    "BSDF_TRANSLUCENT": ("Color", 1.0, 0.0),
    "BSDF_TOON": ("Color", 1.0, 0.0),
    "BSDF_SHEEN": ("Color", "Roughness", 0.0),
    "BSDF_HAIR": ("Color", 1.0, 0.0),
    "BSDF_HAIR_PRINCIPLED": ("Color", "Roughness", 0.0),
    "SUBSURFACE_SCATTERING": ("Color", 1.0, 0.0),
    "EEVEE_SPECULAR": ("Base Color", "Roughness", 0.0),
}


class Surface(NamedTuple):
    """The description of a shader; each entry is a constant (float or RGBA tuple) or an output socket."""

    color: Any
    roughness: Any
    metallic: Any
    weightless: bool = False
    """Emission or transparency: in a mix with a surface, the description of the surface is used."""


_EMITTER = Surface((1.0, 1.0, 1.0, 1.0), 1.0, 0.0, True)
_NOTHING = Surface((0.0, 0.0, 0.0, 1.0), 1.0, 0.0, True)


def _is_socket(value: Any) -> bool:
    return isinstance(value, bpy.types.NodeSocket)


def _input(node: Any, name: Any) -> Any:
    """The source of an input: a constant or the output socket that feeds it."""
    if not isinstance(name, str):
        return name
    socket = node.inputs.get(name)
    if socket is None:
        return 1.0
    if socket.is_linked:
        return socket.links[0].from_socket
    value = socket.default_value
    return tuple(value) if hasattr(value, "__len__") else float(value)


def _mix(tree: Any, factor: Any, a: Any, b: Any) -> Any:
    """a (1 - factor) + b factor."""
    if not (_is_socket(factor) or _is_socket(a) or _is_socket(b)):
        if isinstance(a, tuple):
            return tuple(x + (y - x) * factor for x, y in zip(a, b, strict=True))
        return a + (b - a) * factor
    if not _is_socket(a) and not _is_socket(b) and a == b:
        return a
    color = (
        isinstance(a, tuple)
        or isinstance(b, tuple)
        or "RGBA" in (getattr(a, "type", ""), getattr(b, "type", ""))
    )
    node = tree.nodes.new("ShaderNodeMix")
    node.data_type = "RGBA" if color else "FLOAT"
    node.clamp_factor = True
    kind = "RGBA" if color else "VALUE"
    inputs = [s for s in node.inputs if s.name in ("A", "B") and s.type == kind]
    factor_input = next(s for s in node.inputs if s.name == "Factor" and s.type == "VALUE")
    for socket, value in ((factor_input, factor), (inputs[0], a), (inputs[1], b)):
        _feed(tree, socket, value)
    return next(s for s in node.outputs if s.type == kind)


def _feed(tree: Any, socket: Any, value: Any) -> None:
    if _is_socket(value):
        tree.links.new(value, socket)
    elif hasattr(socket.default_value, "__len__"):
        rgba = value if isinstance(value, tuple) else (value, value, value, 1.0)
        socket.default_value = rgba[: len(socket.default_value)]
    else:
        socket.default_value = sum(value[:3]) / 3 if isinstance(value, tuple) else value


def _group(tree: Any, node: Any, socket: Any, cache: dict) -> Surface:
    """Describes the shader inside a node group and adds group outputs for the description."""
    inner = node.node_tree
    if inner is None:
        return _NOTHING
    key = (inner.name, socket.identifier)
    if key not in cache:
        outputs = [n for n in inner.nodes if n.type == "GROUP_OUTPUT"]
        active: Any = next((n for n in outputs if n.is_active_output), outputs[0] if outputs else None)
        entry = (
            next((s for s in active.inputs if s.identifier == socket.identifier), None) if active else None
        )
        if entry is None or not entry.is_linked:
            return _NOTHING
        surface = describe(inner, entry.links[0].from_socket, cache)
        exposed: list[Any] = []
        for kind, value in zip(("Color", "Float", "Float"), surface[:3], strict=True):
            if not _is_socket(value):
                exposed.append(value)
                continue
            item = inner.interface.new_socket(
                name=f"jaxsr {socket.name} {len(exposed)}", in_out="OUTPUT", socket_type=f"NodeSocket{kind}"
            )
            inner.links.new(value, next(s for s in active.inputs if s.identifier == item.identifier))
            exposed.append(item.identifier)
        cache[key] = Surface(exposed[0], exposed[1], exposed[2], surface.weightless)
    stored = cache[key]
    color, roughness, metallic = (
        next(s for s in node.outputs if s.identifier == value) if isinstance(value, str) else value
        for value in stored[:3]
    )
    return Surface(color, roughness, metallic, stored.weightless)


def describe(tree: Any, socket: Any, cache: dict) -> Surface:
    """The surface that a shader output socket stands for, in terms of sockets of the same tree."""
    node = socket.node
    if node.type == "REROUTE":
        return (
            describe(tree, node.inputs[0].links[0].from_socket, cache)
            if node.inputs[0].is_linked
            else _NOTHING
        )
    if node.type == "GROUP":
        return _group(tree, node, socket, cache)
    if node.type in _BSDFS:
        return Surface(*(_input(node, name) for name in _BSDFS[node.type]))
    if node.type == "EMISSION":
        return _EMITTER
    if node.type in ("MIX_SHADER", "ADD_SHADER"):
        sides = [s for s in node.inputs if s.type == "SHADER"]
        surfaces = [describe(tree, s.links[0].from_socket, cache) if s.is_linked else _NOTHING for s in sides]
        solid = [s for s in surfaces if not s.weightless]
        if len(solid) < 2:
            return solid[0] if solid else next((s for s in surfaces if s is not _NOTHING), _NOTHING)
        factor = _input(node, node.inputs[0].name) if node.type == "MIX_SHADER" else 0.5
        a, b = surfaces
        return Surface(*(_mix(tree, factor, x, y) for x, y in zip(a[:3], b[:3], strict=True)))
    return _NOTHING


def _material_tree(material: Any) -> Any:
    """The node tree; a material that shades with its viewport colour gets nodes that say the same."""
    if material.node_tree is None or not material.use_nodes:
        color = tuple(material.diffuse_color)
        material.use_nodes = True
        tree = material.node_tree
        tree.nodes.clear()
        output = tree.nodes.new("ShaderNodeOutputMaterial")
        bsdf = tree.nodes.new("ShaderNodeBsdfDiffuse")
        bsdf.inputs["Color"].default_value = color
        tree.links.new(bsdf.outputs[0], output.inputs["Surface"])
    return material.node_tree


def add_outputs(material: Any, cache: dict) -> None:
    """Adds the AOV outputs to one material."""
    tree = _material_tree(material)
    ours = (COLOR_AOV, *VALUE_AOVS, INSTANCE_AOV)
    for node in [n for n in tree.nodes if n.type == "OUTPUT_AOV" and n.aov_name in ours]:
        tree.nodes.remove(node)
    output = tree.get_output_node("CYCLES")
    surface = _NOTHING
    if output is not None and output.inputs["Surface"].is_linked:
        surface = describe(tree, output.inputs["Surface"].links[0].from_socket, cache)
    for name, value in zip((COLOR_AOV, *VALUE_AOVS), surface[:3], strict=True):
        aov = tree.nodes.new("ShaderNodeOutputAOV")
        aov.aov_name = name
        _feed(tree, aov.inputs["Color" if name == COLOR_AOV else "Value"], value)
    info = tree.nodes.new("ShaderNodeObjectInfo")
    aov = tree.nodes.new("ShaderNodeOutputAOV")
    aov.aov_name = INSTANCE_AOV
    tree.links.new(info.outputs["Random"], aov.inputs["Value"])


def prepare_materials(scene: Any, view_layer: Any) -> None:
    """Adds the outputs to all materials, a plain grey to objects without one, and the AOVs to the layer."""
    default = bpy.data.materials.new("jaxsr default")
    default.use_nodes = True
    default.node_tree.nodes.clear()
    output = default.node_tree.nodes.new("ShaderNodeOutputMaterial")
    bsdf = default.node_tree.nodes.new(
        "ShaderNodeBsdfDiffuse"
    )  # the colour that Cycles uses without a material
    bsdf.inputs["Color"].default_value = (0.8, 0.8, 0.8, 1.0)
    default.node_tree.links.new(bsdf.outputs[0], output.inputs["Surface"])
    for obj in bpy.data.objects:
        if obj.type not in RENDERED_TYPES or obj.data is None:
            continue
        if len(obj.material_slots) == 0 and hasattr(obj.data, "materials"):
            obj.data.materials.append(default)
        for slot in obj.material_slots:
            if slot.material is None:
                slot.material = default
    cache: dict = {}
    for material in sorted(bpy.data.materials, key=lambda m: m.name_full):
        if not getattr(material, "is_grease_pencil", False):
            add_outputs(material, cache)
    for name in (COLOR_AOV, *VALUE_AOVS, INSTANCE_AOV):
        aov = next((a for a in view_layer.aovs if a.name == name), None) or view_layer.aovs.add()
        aov.name = name
        aov.type = "COLOR" if name == COLOR_AOV else "VALUE"
