"""Where methods are told apart: masks of an image's edges and of what has just come into view.

Masks are bool `[H, W]`, True where a pixel counts, at the size of the HR G-buffer; `metrics.measure_frame`
takes them. They are made of the G-buffer alone: they are the same for all methods, and noise of the truth
is no edge.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxsr.frames import Frame, GBuffer
from jaxsr.ops.masks import depth_mask, disocclusion_mask
from jaxsr.report.results import BEND


@jax.jit
def _edges(depth: Array) -> Array:
    # 1/depth is linear over the image of a plane at any slant, and 0 for sky.
    inverse = 1 / depth[..., 0]
    masks = []
    for v in (inverse, inverse.T):
        before, middle, after = v[:-2], v[1:-1], v[2:]
        largest = jnp.maximum(jnp.maximum(before, after), middle)
        bent = jnp.abs(before + after - 2 * middle) > BEND * largest
        masks.append(jnp.zeros(v.shape, bool).at[1:-1].set(bent))
    return masks[0] | masks[1].T


def edges(gbuffer: GBuffer) -> Bool[np.ndarray, "h w"]:
    """The edges of an HR G-buffer, of its depth alone; see `REGIONS`. At the border along the border only."""
    return np.asarray(_edges(gbuffer.depth_linear))


def disocclusions(frame: Frame, previous: Frame | None) -> Bool[np.ndarray, "h w"]:
    """What the HR frame shows and the previous one did not; see `REGIONS`.

    Where the camera of either frame is not known, depth and motion alone tell (`ops.masks.depth_mask`). They
    find less: 70 % of the hidden pixels of the analytic scene, where the camera finds 95 %. A surface then
    also counts if its depth changes by more than 5 % in one frame.
    """
    if previous is None or bool(frame.reset):
        return np.zeros(frame.hr.depth_linear.shape[:2], bool)
    if frame.camera is None or previous.camera is None:
        valid = depth_mask(frame.hr.depth_linear, previous.hr.depth_linear, frame.hr.motion_px)
    else:
        valid = disocclusion_mask(frame.hr, previous.hr, frame.camera, previous.camera)
    return np.asarray(valid)[..., 0] == 0


def regions(frame: Frame, previous: Frame | None) -> dict[str, Bool[np.ndarray, "h w"]]:
    """The mask of each of `REGIONS` for a frame.

    Args:
        frame: of one image, not a batch.
        previous: the frame before it; None at a start.
    """
    return {"edges": edges(frame.hr), "disocclusions": disocclusions(frame, previous)}
