"""An analytic scene with exact ground truth at any size: textured quads and spheres under a sun.

It is ray cast in NumPy float64 with one sample per pixel, so that every buffer is exact: depth, motion,
normals, object ids and whether a point was visible one frame before. The camera turns and travels, a sphere
rolls, a panel slides and a thin pole stands in front. Buffers obey `jaxsr.frames`; layer names are those of
sequences on disk. There is no anti-aliasing and no indirect light. Time is counted in
frames and lengths in units of the world (z is up). Unlike elsewhere in jaxsr, sizes are (width, height).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import Camera, Frame, GBuffer, Scale
from jaxsr.ops.pinhole import pixels_from_world, rotate, unjittered_positions, view_rays

_SUN = np.array([0.45, -0.55, 0.70]) / np.linalg.norm([0.45, -0.55, 0.70])


@dataclass(frozen=True)
class Material:
    """A procedural base colour: two colours mixed by a smooth checker of `frequency` per unit length."""

    dark: tuple[float, float, float]
    light: tuple[float, float, float]
    frequency: float
    roughness: float = 0.6
    metallic: float = 0.0

    def base_color(self, uv: np.ndarray) -> np.ndarray:
        """Base colour `[..., 3]`, linear in [0, 1], at surface coordinates `[..., 2]`."""
        wave = np.sin(uv[..., 0] * self.frequency) * np.sin(uv[..., 1] * self.frequency)
        mix = (0.5 + 0.5 * np.tanh(4.0 * wave))[..., None]
        return (1.0 - mix) * np.array(self.dark) + mix * np.array(self.light)


@dataclass(frozen=True)
class Sphere:
    """A textured ball that moves evenly, in units per frame, and spins about its vertical axis.

    "Local" points are those at time 0: the local position of a surface point never changes.
    """

    center: tuple[float, float, float]
    radius: float
    velocity: tuple[float, float, float]
    spin: float
    """Radians per frame about the vertical axis."""
    material: Material

    def intersect(self, origin: np.ndarray, rays: np.ndarray, time: float) -> np.ndarray:
        """Distance `[...]`, in lengths of the ray, to the near side along `[..., 3]` rays; inf if missed.

        `origin` is `[3]` or `[..., 3]`. A ray that starts inside misses.
        """
        offset = origin - (np.array(self.center) + time * np.array(self.velocity))
        a = np.sum(rays * rays, -1)
        b = np.sum(rays * offset, -1)
        c = np.sum(offset * offset, -1) - self.radius**2
        root = b * b - a * c
        with np.errstate(invalid="ignore"):
            near = (-b - np.sqrt(root)) / a
        return np.where((root > 0) & (near > 1e-6), near, np.inf)

    def to_local(self, points: np.ndarray, time: float) -> np.ndarray:
        """World points `[..., 3]` at `time` in the frame of the ball, its centre at 0."""
        centered = points - (np.array(self.center) + time * np.array(self.velocity))
        return centered @ _rotation_z(self.spin * time)  # the transpose turns back

    def to_world(self, points: np.ndarray, time: float) -> np.ndarray:
        """The inverse of `to_local`."""
        turned = points @ _rotation_z(self.spin * time).T
        return turned + np.array(self.center) + time * np.array(self.velocity)

    def normal(self, points: np.ndarray, rays: np.ndarray, time: float) -> np.ndarray:
        """Outward unit normals `[..., 3]` at world points; `rays` do not matter."""
        return (points - (np.array(self.center) + time * np.array(self.velocity))) / self.radius

    def uv(self, local: np.ndarray) -> np.ndarray:
        """Longitude and latitude `[..., 2]` of local points, in radians."""
        u = np.arctan2(local[..., 1], local[..., 0])
        v = np.arcsin(np.clip(local[..., 2] / self.radius, -1.0, 1.0))
        return np.stack([u, v], -1)


@dataclass(frozen=True)
class Quad:
    """A textured rectangle, seen from both sides, that moves evenly, in units per frame.

    The edges are at right angles and start at `origin`. "Local" points are world points at time 0.
    """

    origin: tuple[float, float, float]
    edge_u: tuple[float, float, float]
    edge_v: tuple[float, float, float]
    velocity: tuple[float, float, float]
    material: Material

    def _frame(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Both edges and the unit normal, `[3]` each."""
        u, v = np.array(self.edge_u), np.array(self.edge_v)
        n = np.cross(u, v)
        return u, v, n / np.linalg.norm(n)

    def intersect(self, origin: np.ndarray, rays: np.ndarray, time: float) -> np.ndarray:
        """Distance `[...]`, in lengths of the ray, along `[..., 3]` rays; inf if missed."""
        u, v, n = self._frame()
        start = np.array(self.origin) + time * np.array(self.velocity)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sum((start - origin) * n, -1) / np.sum(rays * n, -1)
            hit = origin + t[..., None] * rays - start
            a = np.sum(hit * u, -1) / np.dot(u, u)
            b = np.sum(hit * v, -1) / np.dot(v, v)
        inside = (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1) & (t > 1e-6)
        return np.where(inside, t, np.inf)

    def to_local(self, points: np.ndarray, time: float) -> np.ndarray:
        """World points `[..., 3]` at `time`, moved back to time 0."""
        return points - time * np.array(self.velocity)

    def to_world(self, points: np.ndarray, time: float) -> np.ndarray:
        """The inverse of `to_local`."""
        return points + time * np.array(self.velocity)

    def normal(self, points: np.ndarray, rays: np.ndarray, time: float) -> np.ndarray:
        """Unit normals `[..., 3]` at world points, on the side from which the `[..., 3]` rays come."""
        n = np.broadcast_to(self._frame()[2], points.shape)
        return np.where(np.sum(n * rays, -1, keepdims=True) > 0, -n, n)

    def uv(self, local: np.ndarray) -> np.ndarray:
        """Distances `[..., 2]` of local points along the edges, from the origin."""
        u, v, _ = self._frame()
        offset = local - np.array(self.origin)
        return np.stack([offset @ (u / np.linalg.norm(u)), offset @ (v / np.linalg.norm(v))], -1)


def scene() -> tuple[Sphere | Quad, ...]:
    """The objects; their numbers in `object_id` count from 1 in this order."""
    stone = Material((0.25, 0.22, 0.20), (0.62, 0.58, 0.50), 2.2, roughness=0.8)
    brick = Material((0.45, 0.16, 0.10), (0.70, 0.62, 0.55), 3.1, roughness=0.7)
    ball = Material((0.08, 0.20, 0.55), (0.85, 0.80, 0.30), 5.0, roughness=0.3)
    metal = Material((0.55, 0.52, 0.48), (0.75, 0.72, 0.66), 6.0, roughness=0.25, metallic=1.0)
    panel = Material((0.10, 0.40, 0.25), (0.80, 0.85, 0.75), 4.0, roughness=0.5)
    return (
        Quad((-30, -30, 0), (60, 0, 0), (0, 60, 0), (0, 0, 0), stone),
        Quad((-9, 7, 0), (14, 0, 0), (0, 0, 4.2), (0, 0, 0), brick),
        Sphere((-2.0, 2.2, 1.0), 1.0, (0.07, 0.01, 0), 0.05, ball),
        Sphere((1.9, 3.4, 0.8), 0.8, (0, 0, 0), 0.0, metal),
        Quad((0.4, 1.4, 0.5), (1.1, 0.2, 0), (0, 0, 1.3), (-0.05, 0, 0), panel),
        Quad((-0.6, -0.6, 0), (0.05, 0.01, 0), (0, 0, 3.0), (0, 0, 0), metal),
    )


def camera(time: float, size: tuple[int, int], *, still: bool = False) -> Camera:
    """The travelling camera at a time in frames; `still` freezes it at time 0."""
    t = 0.0 if still else time
    position = np.array([0.6 + 0.06 * t, -5.5 + 0.05 * t, 1.8 + 0.01 * t])
    yaw, pitch = 0.06 - 0.012 * t, -0.06
    forward = np.array([-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    matrix: Any = np.eye(4)
    matrix[:3, 0], matrix[:3, 1], matrix[:3, 2] = right, np.cross(forward, right), forward
    matrix[:3, 3] = position
    half_fov: Any = np.array([0.62, 0.62 * size[1] / size[0]])
    shift: Any = np.zeros(2)
    return Camera(world_from_view=matrix, tan_half_fov=half_fov, lens_shift=shift)


def render(
    time: float,
    size: tuple[int, int],
    *,
    jitter_px: tuple[float, float] = (0.0, 0.0),
    still: bool = False,
    frozen: bool = False,
) -> dict[str, np.ndarray]:
    """Ray cast one frame.

    Args:
        time: time in frames; the previous frame is `time - 1`.
        size: (width, height) in pixels.
        jitter_px: J in pixels of this image; the pixel at p shows the scene at p + J.
        still: the camera does not move.
        frozen: the objects do not move.

    Returns:
        float32 layers `[H, W, C]`: color, depth, motion (unjittered), normal, base_color, roughness,
        metallic, object_id, position, and visible_before: 1 where the point was in view and unoccluded
        one frame before.
    """
    view, before = camera(time, size, still=still), camera(time - 1, size, still=still)
    now, then = (0.0, 0.0) if frozen else (time, time - 1)
    w, h = size
    pixels = unjittered_positions((h, w), jitter_px, np.float64, np)
    origin: Any = view.world_from_view[:3, 3]
    rays = rotate(view.world_from_view[:3, :3], view_rays(pixels, view, (h, w), np), np)
    objects = scene()
    distance, index = _nearest(objects, origin, rays, now)
    hit = index >= 0
    points = origin + np.where(hit, distance, 1.0)[..., None] * rays

    zeros = np.zeros((h, w, 3))
    normal, base, past = zeros.copy(), zeros.copy(), zeros.copy()
    roughness, metallic = np.zeros((h, w, 1)), np.zeros((h, w, 1))
    for i, item in enumerate(objects):
        mask = index == i
        local = item.to_local(points[mask], now)
        normal[mask] = item.normal(points[mask], rays[mask], now)
        base[mask] = item.material.base_color(item.uv(local))
        past[mask] = item.to_world(local, then)
        roughness[mask], metallic[mask] = item.material.roughness, item.material.metallic

    color = _shade(objects, points, rays, normal, base, roughness, metallic, hit, now)
    # Sky is infinitely far: only the rotation of the camera moves it.
    past = np.where(hit[..., None], past, before.world_from_view[:3, 3] + rays * 1e9)
    position_before, depth_before = pixels_from_world(past, before, (h, w), np)
    there = np.where(hit[..., None], points, origin + rays * 1e9)
    position_now, depth_now = pixels_from_world(there, view, (h, w), np)
    motion = position_now - position_before

    inside = np.all((position_before > -0.5) & (position_before < np.array([w, h]) - 0.5), -1)
    inside &= depth_before[..., 0] > 0
    back_origin: Any = before.world_from_view[:3, 3]
    back_rays = np.where(hit[..., None], past - back_origin, rays)
    back_distance, _ = _nearest(objects, back_origin, back_rays, then)
    visible = inside & np.where(hit, back_distance > 1 - 1e-4, ~np.isfinite(back_distance))
    layers = {
        "color": color,
        "depth": np.where(hit[..., None], depth_now, np.inf),
        "motion": motion,
        "normal": normal,
        "base_color": base,
        "roughness": roughness,
        "metallic": metallic,
        "object_id": (index + 1.0)[..., None],
        "position": np.where(hit[..., None], points, 0.0),
        "visible_before": visible[..., None],
    }
    return {name: value.astype(np.float32) for name, value in layers.items()}


def gbuffer(layers: dict[str, Any]) -> GBuffer:
    """The G-buffer of rendered layers, as NumPy arrays."""
    return GBuffer(
        depth_linear=layers["depth"],
        motion_px=layers["motion"],
        normal=layers["normal"],
        base_color=layers["base_color"],
        roughness=layers["roughness"],
        metallic=layers["metallic"],
        object_id=layers["object_id"],
    )


def frame(
    time: int,
    size: tuple[int, int],
    scale: int,
    jitter_px: tuple[float, float],
    *,
    rendered: bool = True,
    hr_jitter_px: tuple[float, float] = (0.0, 0.0),
) -> tuple[Frame, np.ndarray]:
    """One `Frame` of HR `size` with its truth `[H, W, 3]`; an unrendered frame has no colour.

    Args:
        time: the number of the frame; 0 is a reset.
        size: (width, height) of the HR image, whole multiples of `scale`.
        scale: HR size divided by LR size.
        jitter_px: J in LR pixels.
        rendered: whether the frame has LR colour.
        hr_jitter_px: J of the HR buffers, in HR pixels.
        rendered: False leaves the LR colour zero.

    Returns:
        The frame, unbatched, its arrays NumPy float32, and the HR colour, linear and unjittered.

    Raises:
        JaxsrError: `size` is not a whole multiple of `scale`.
    """
    if scale < 1 or size[0] % scale or size[1] % scale:
        raise JaxsrError(
            "size is no multiple of scale",
            where="analytic.frame",
            expected=f"multiples of {scale}",
            found=f"{size[0]} x {size[1]}",
        )
    hr = render(time, size)
    buffers = render(time, size, jitter_px=hr_jitter_px) if any(hr_jitter_px) else hr
    lr = render(time, (size[0] // scale, size[1] // scale), jitter_px=jitter_px)
    view = Camera(*(value.astype(np.float32) for value in camera(time, size)))
    color: Any = lr["color"] if rendered else np.zeros_like(lr["color"])
    flags: Any = (np.asarray(time == 0), np.asarray(rendered), np.ones((), np.float32))
    jitter: Any = np.asarray(jitter_px, np.float32)
    result = Frame(
        color_linear=color,
        lr=gbuffer(lr),
        hr=gbuffer(buffers),
        jitter_px=jitter,
        hr_jitter_px=np.asarray(hr_jitter_px, np.float32),  # type: ignore[arg-type]
        camera=view,
        reset=flags[0],
        rendered=flags[1],
        exposure=flags[2],
        factor=Scale(scale),
    )
    return result, hr["color"]


def _rotation_z(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _nearest(
    objects: tuple[Sphere | Quad, ...], origin: np.ndarray, rays: np.ndarray, time: float
) -> tuple[np.ndarray, np.ndarray]:
    """Distance `[...]` to the nearest object in lengths of the ray, and its index; inf and -1 for sky."""
    distances = np.stack([item.intersect(origin, rays, time) for item in objects])
    index = np.argmin(distances, 0)
    distance = np.min(distances, 0)
    return distance, np.where(np.isfinite(distance), index, -1)


def _shade(
    objects: tuple[Sphere | Quad, ...],
    points: np.ndarray,
    rays: np.ndarray,
    normal: np.ndarray,
    base: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
    hit: np.ndarray,
    time: float,
) -> np.ndarray:
    """Linear colour `[H, W, 3]`: sun with hard shadows, ambient sky, a Blinn highlight; a gradient sky.

    `points`, `rays`, `normal` and `base` are `[H, W, 3]`, `roughness` and `metallic` `[H, W, 1]`, `hit` is
    `[H, W]`.
    """
    lifted = points + 1e-4 * normal
    distance, _ = _nearest(objects, lifted, np.broadcast_to(_SUN, points.shape), time)
    lit = (~np.isfinite(distance))[..., None]
    toward = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    half = toward + _SUN
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    cosine = np.maximum(np.sum(normal * _SUN, -1, keepdims=True), 0.0)
    shine = 2.0 / np.maximum(roughness, 0.05) ** 2
    highlight = (
        np.maximum(np.sum(normal * half, -1, keepdims=True), 0.0) ** shine * (0.04 + 0.96 * metallic) * 4
    )
    ambient = np.array([0.20, 0.24, 0.30]) * (0.75 + 0.25 * normal[..., 2:])
    sun = np.array([1.50, 1.35, 1.10]) * cosine * lit
    surface = base * (ambient + sun) + np.where(metallic > 0.5, base, 1.0) * highlight * sun
    sky_mix = np.clip(-toward[..., 2:] * 2.0, 0.0, 1.0)
    sky = (1 - sky_mix) * np.array([0.75, 0.80, 0.85]) + sky_mix * np.array([0.20, 0.40, 0.80])
    return np.where(hit[..., None], surface, sky)
