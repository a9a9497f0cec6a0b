"""Pure functions on arrays: no files, no networks, no state.

A function of images takes one `[H, W, C]` or a batch `[B, H, W, C]`. It is jitted, and it is differentiable
unless its docstring says otherwise. Masks and motion are images in this sense. `halton` and `jitter_sequence`
compute in NumPy on the host; `pixel_grid` and `demodulation_divisor` are plain expressions. `jaxsr.frames`
states the conventions.
"""

from jaxsr.ops.color import (
    from_display,
    inverse_tone_map,
    linear_from_srgb,
    luminance,
    rgb_from_ycocg,
    srgb_from_linear,
    to_display,
    tone_map,
    ycocg_from_rgb,
)
from jaxsr.ops.demodulation import demodulate, demodulation_divisor, modulate
from jaxsr.ops.geometry import camera_motion, previous_depth, project, view_directions, world_position
from jaxsr.ops.jitter import (
    SamplePositions,
    current_positions,
    halton,
    jitter_sequence,
    jittered_motion,
    positions_from_jittered_motion,
    positions_from_motion,
    sample_jittered,
    unjittered_motion,
)
from jaxsr.ops.masks import (
    blend_mask,
    depth_mask,
    disocclusion_mask,
    normal_mask,
    position_mask,
    stencil_mask,
)
from jaxsr.ops.motion import dilate_motion, hr_from_lr
from jaxsr.ops.reprojection import reproject
from jaxsr.ops.resampling import (
    pixel_grid,
    pixel_shuffle,
    pixel_unshuffle,
    resize,
    sample,
    upsample,
    zero_upsample,
)
from jaxsr.ops.warping import (
    backward_warp,
    compose_motion,
    forward_splat,
    occlusion_motion,
    warp_zero_upsampled,
)

__all__ = [
    "SamplePositions",
    "backward_warp",
    "blend_mask",
    "camera_motion",
    "compose_motion",
    "current_positions",
    "demodulate",
    "demodulation_divisor",
    "depth_mask",
    "dilate_motion",
    "disocclusion_mask",
    "forward_splat",
    "from_display",
    "halton",
    "hr_from_lr",
    "inverse_tone_map",
    "jitter_sequence",
    "jittered_motion",
    "linear_from_srgb",
    "luminance",
    "modulate",
    "normal_mask",
    "occlusion_motion",
    "pixel_grid",
    "pixel_shuffle",
    "pixel_unshuffle",
    "position_mask",
    "positions_from_jittered_motion",
    "positions_from_motion",
    "previous_depth",
    "project",
    "reproject",
    "resize",
    "rgb_from_ycocg",
    "sample",
    "sample_jittered",
    "srgb_from_linear",
    "stencil_mask",
    "to_display",
    "tone_map",
    "unjittered_motion",
    "upsample",
    "view_directions",
    "warp_zero_upsampled",
    "world_position",
    "ycocg_from_rgb",
    "zero_upsample",
]
