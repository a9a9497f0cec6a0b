"""Blender's raw channels to canonical layers, as pure functions of arrays; needs no Blender.

Blender's names (4.5 and 5 differ), signs and codes end here: Vector points to the previous position with y
up, depth 1e10 is sky, instances share the pass index of their object.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera
from jaxsr.io.writing import HALF_MAX
from jaxsr.ops.pinhole import BEHIND_PX, still_motion

SKY_DEPTH = 1e9
"""Blender writes 1e10 where a ray hits nothing."""


class Instances(NamedTuple):
    """The data that separate instances: Blender gives all instances of an object the same pass index."""

    objects: int
    """Largest pass index."""
    instanced: Sequence[int] = ()
    """Pass indices of objects that appear as instances."""
    random_ids: Sequence[int] = ()
    """Random ids (32 bits, sorted) of the instances; the AOV `instance` holds them divided by 2^32."""


def camera_from_json(entry: Mapping[str, Any]) -> Camera:
    """A camera as the script describes it, in float64."""
    return Camera(*(np.asarray(entry[name], np.float64) for name in Camera._fields))  # type: ignore[arg-type]


def sky_motion(
    camera: Camera, previous: Camera, size: tuple[int, int], jitter_px: tuple[float, float] = (0.0, 0.0)
) -> Float[np.ndarray, "h w 2"]:
    """Backward motion of points at infinity: it depends on the rotation of the camera alone.

    Args:
        camera: of this frame (frames.Camera, NumPy).
        previous: of the frame before.
        size: `(w, h)` of the image.
        jitter_px: J; pixel p shows what lies at p + J.

    Returns:
        `motion_px` in pixels of this image. Zero where the direction lay behind the previous camera.
    """
    sky = np.full((size[1], size[0], 1), np.inf)
    motion = still_motion(sky, camera, previous, jitter_px, np)
    # About -BEHIND_PX means that there was no previous pixel.
    return np.where(motion < -BEHIND_PX / 2, motion, 0.0)


def convert_color(raw: Mapping[str, np.ndarray]) -> Float[np.ndarray, "h w 3"]:
    """Scene-linear colour from Blender's channels; the rare NaN of a renderer becomes 0."""
    color = np.stack([_channel(raw, "Combined", c) for c in "RGB"], -1).astype(np.float32)
    return np.nan_to_num(color, nan=0.0, posinf=HALF_MAX, neginf=0.0)


def convert_gbuffer(
    raw: Mapping[str, np.ndarray],
    camera: Camera,
    previous: Camera,
    jitter_px: tuple[float, float] = (0.0, 0.0),
    instances: Instances | None = None,
    position: bool = False,
) -> dict[str, Float[np.ndarray, "h w _"]]:
    """The canonical G-buffer layers from Blender's channels.

    Args:
        raw: channels of a multi-layer OpenEXR file of Blender 4.5 or 5, any view layer: `ViewLayer.Depth.Z`,
            `ViewLayer.Vector.X`, ...
        camera: of this frame, without jitter.
        previous: the same camera one frame before.
        jitter_px: J of the image, zero for HR.
        instances: how to number instances; None leaves them the number of their object.
        position: also return the world position.

    Returns:
        Layers depth, motion, normal, base_color, roughness, metallic, object_id (and position) as float32
        `[h, w, c]`, in the conventions of jaxsr.frames.

    Raises:
        JaxsrError: a channel is missing.
    """
    depth = _channel(raw, "Depth", "Z").astype(np.float32)
    h, w = depth.shape
    sky = ~(depth < SKY_DEPTH)
    vector = np.stack([_channel(raw, "Vector", c) for c in "XY"], -1).astype(np.float64)
    motion = vector * (-1.0, 1.0)  # Vector points to the previous position, y up
    motion = np.where(sky[..., None], sky_motion(camera, previous, (w, h), jitter_px), motion)
    normal = np.stack([_channel(raw, "Normal", c) for c in "XYZ"], -1).astype(np.float32)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1), 0)
    layers = {
        "depth": np.where(sky, np.inf, depth)[..., None],
        "motion": motion,
        "normal": normal,
        "base_color": np.stack([_channel(raw, "base_color", c) for c in "RGB"], -1),
        "roughness": _channel(raw, "roughness", "XV")[..., None],
        "metallic": _channel(raw, "metallic", "XV")[..., None],
        "object_id": _object_ids(raw, instances)[..., None],
    }
    if position:
        layers["position"] = np.stack([_channel(raw, "Position", c) for c in "XYZ"], -1)
    for name in set(layers) - {"depth", "motion"}:
        layers[name] = np.where(sky[..., None], 0, layers[name])
    return {name: x.astype(np.float32) for name, x in layers.items()}


def _object_ids(raw: Mapping[str, np.ndarray], instances: Instances | None) -> Float[np.ndarray, "h w"]:
    """Pass indices; instances are numbered behind the objects, in the order of their random ids."""
    ids = np.rint(_channel(raw, ("Object Index", "IndexOB"), "XV").astype(np.float64))
    if instances is None or not instances.instanced or not instances.random_ids:
        return ids
    table = np.asarray(instances.random_ids, np.float64) / 2.0**32
    value = _channel(raw, "instance", "XV").astype(np.float64)
    rank = np.searchsorted((table[1:] + table[:-1]) / 2, value)
    known = np.abs(table[rank] - value) < 2.0**-22
    # Instances that appeared after the first frame get a number from their random id.
    late = len(table) + np.floor(value * 2**20)
    return np.where(
        np.isin(ids, np.asarray(instances.instanced)),
        instances.objects + 1 + np.where(known, rank, late),
        ids,
    )


def _channel(raw: Mapping[str, np.ndarray], layer: str | tuple[str, ...], letters: str) -> np.ndarray:
    """The channel `<any view layer>.<layer>.<one of letters>`."""
    layers = (layer,) if isinstance(layer, str) else layer
    endings = [f"{name}.{letter}" for name in layers for letter in letters]
    for name, pixels in raw.items():
        if any(name == ending or name.endswith(f".{ending}") for ending in endings):
            return pixels
    raise JaxsrError(f"missing channel {endings[0]!r}", where="raw render", found=", ".join(sorted(raw)))
