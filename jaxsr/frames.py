"""The conventions, and the small pytrees that carry them. Nothing else in jaxsr defines any.

Arrays are channels-last: images `[H, W, C]`, batches `[B, H, W, C]`, float32.

Pixels: x points right, y points down, integers are pixel centres. A point at `x_hr` in an image that
is `s` times larger lies at `x_lr = (x_hr + 0.5) / s - 0.5`. Vectors of pixels are (x, y).

Motion is backward, in pixels of its own image, and knows nothing of jitter: `p_prev = p - motion_px`.

Jitter J is in pixels of the low-resolution (LR) image, in [-0.5, 0.5]. The jittered image shows at p what
the unjittered one has at p + J: `I_J(p) = I_N(p + J)`. High-resolution (HR) buffers are not jittered.

Colour is scene-linear and unbounded, with the primaries of Rec. 709. Depth is linear view depth (distance
along the viewing axis), above 0, +inf for sky; nothing else says what is sky. Normals are unit vectors in
world space, zero for sky. Base colour is 0 for sky, and may be 0 on a surface as well.

View space: x right, y down, z forward. World space: whatever the scene has, right-handed.

Names carry the unit or the space where there is doubt: `motion_px`, `depth_linear`, `color_linear`.
`LAYERS` is the table of all buffers.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsr.layers import FIELDS, LAYERS, Layer

__all__ = ["FIELDS", "LAYERS", "Camera", "Frame", "GBuffer", "Layer", "Scale", "Window", "surface"]


class Camera(NamedTuple):
    """A pinhole camera, independent of any resolution.

    A view-space point (x, y, z) projects to `ndc = (x, y) / (z * tan_half_fov) - lens_shift` in [-1, 1],
    x right and y down, and to pixels by `p = (ndc + 1) / 2 * (W, H) - 0.5`.
    """

    world_from_view: Float[Array, "*b 4 4"]
    """Rigid transform from view space to world space."""
    tan_half_fov: Float[Array, "*b 2"]
    """Tangents of half the horizontal and half the vertical field of view."""
    lens_shift: Float[Array, "*b 2"]
    """Offset of the optical axis, in units of half the image; zero for an ordinary lens."""


class GBuffer(NamedTuple):
    """What a rasteriser knows about each pixel before shading.

    A buffer that was not exported, or that the method does not need, is None. Depth and motion are typed as
    if they were always there, since nearly all code that reads them has asked for them.
    """

    depth_linear: Float[Array, "*b h w 1"] = None  # type: ignore[assignment]
    motion_px: Float[Array, "*b h w 2"] = None  # type: ignore[assignment]
    normal: Float[Array, "*b h w 3"] | None = None
    base_color: Float[Array, "*b h w 3"] | None = None
    roughness: Float[Array, "*b h w 1"] | None = None
    metallic: Float[Array, "*b h w 1"] | None = None
    object_id: Float[Array, "*b h w 1"] | None = None
    """Whole numbers; 0 for sky."""


@jax.tree_util.register_static
class Scale(int):
    """HR size divided by LR size. It is part of a pytree's structure, so that compiled code knows it."""


class Frame(NamedTuple):
    """All that a method may see of one frame. The truth is not part of it.

    `color_linear` is zero where `rendered` is False: such a frame has only its G-buffers and must be
    extrapolated. At scale 1 the two G-buffers are equal. `jaxsr.Frame.of` makes a frame of the arrays that
    one has, and says what is wrong with them.
    """

    color_linear: Float[Array, "*b h w 3"]
    """The jittered LR render."""
    lr: GBuffer
    """Jittered, at the size of `color_linear`."""
    hr: GBuffer
    """At the size of the output; jittered by `hr_jitter_px`, which is most often 0."""
    jitter_px: Float[Array, "*b 2"]
    """J of this frame, in LR pixels."""
    camera: Camera | None
    """None where it is not known."""
    reset: Bool[Array, "*b"]
    """True where this frame does not continue the one before it: history must be dropped."""
    rendered: Bool[Array, "*b"]
    """False where the frame was never shaded."""
    exposure: Float[Array, "*b"]
    """Factor on linear colour before the display tone map."""
    hr_jitter_px: Float[Array, "*b 2"]
    """J of the HR buffers, in HR pixels: 0 where they are not jittered. Output and truth never are."""
    factor: Scale = Scale(1)
    """HR size divided by LR size, for the pytree; `scale` is the plain number."""

    @classmethod
    def of(
        cls,
        color: Any = None,
        *,
        depth: Any = None,
        motion: Any = None,
        jitter: Any = (0.0, 0.0),
        hr_jitter: Any = (0.0, 0.0),
        reset: Any = False,
        exposure: Any = 1.0,
        lr: Mapping[str, Any] | None = None,
        hr: Mapping[str, Any] | None = None,
        camera: Camera | None = None,
        rendered: bool = True,
        scale: int | None = None,
    ) -> "Frame":
        """A frame of the arrays that one has, NumPy's or JAX's; what is left out is filled in.

        Args:
            color: the jittered LR render `[h, w, 3]`, scene-linear. Not needed if `rendered` is False.
            depth: LR linear view depth `[h, w, 1]` or `[h, w]`, +inf for sky.
            motion: LR backward motion `[h, w, 2]` in LR pixels, without jitter.
            jitter: J (x, y) in LR pixels, each in [-0.5, 0.5].
            hr_jitter: J (x, y) of the HR buffers in HR pixels, each at most half an LR pixel. HR buffers that
                were rendered with the projection of the LR frame have the scale times `jitter`.
            reset: True where this frame does not continue the one before it.
            exposure: factor on linear colour before the display tone map, above 0.
            lr: further LR layers by name, such as `{"base_color": ..., "normal": ...}`.
            hr: HR layers by name, such as `{"depth": ..., "motion": ...}`; motion in HR pixels.
            camera: where it is known.
            rendered: False for a frame that has only its G-buffers and is to be extrapolated.
            scale: HR size over LR size, where the sizes of the arrays do not tell.

        Raises:
            JaxsrError: it names the argument, and says what was expected and found.
        """
        from jaxsr.frame_input import make_frame  # it needs this class

        low = {"color": color, "depth": depth, "motion": motion}
        return make_frame(
            {k: v for k, v in low.items() if v is not None} | dict(lr or {}),
            dict(hr or {}),
            jitter=jitter,
            hr_jitter=hr_jitter,
            exposure=exposure,
            camera=camera,
            reset=reset,
            rendered=rendered,
            scale=scale,
        )

    @property
    def scale(self) -> int:
        """HR size divided by LR size."""
        return int(self.factor)

    @property
    def size(self) -> tuple[int, int]:
        """(H, W) of the output."""
        height, width = self.color_linear.shape[-3:-1]
        return height * self.scale, width * self.scale

    @property
    def exposed(self) -> Float[Array, "*b h w 3"]:
        """Colour times exposure."""
        return self.color_linear * self.exposure[..., None, None, None]


class Window(NamedTuple):
    """Consecutive frames, or crops of them, with their truth: what training sees and inference never does.

    A batch of windows has `[B, T]` in front of the shapes of one frame. The truth is that of the M frames
    that are to be made, in the order of time.
    """

    frames: Frame
    truth_linear: Float[Array, "*b H W 3"]
    """`[B, M, H, W, 3]`: HR colour, scene-linear, not jittered."""
    lr_truth_linear: Float[Array, "*b h w 3"] | None = None
    """`[B, M, h, w, 3]`: LR colour, jittered, of the same frames; None where it is not asked for."""


def surface(depth_linear: Float[Array, "*b h w 1"]) -> Bool[Array, "*b h w 1"]:
    """True where a pixel shows a surface, False for sky."""
    return jnp.isfinite(depth_linear)
