"""Settings in files of weights that earlier versions of jaxsr wrote: understood for ever.

Version 0.1 recorded some settings as "arguments", under other names and together with the weights of the
loss. It left out the constants of the filters; they are written here as they were then, whatever the defaults
are now.
"""

from collections.abc import Mapping
from typing import Any

_LOSS = ("ssim_weight", "l1_weight", "perceptual_weight", "perceptual_crop")
_RENAMED = {"follow_jitter": "unjitter", "compute": "dtype"}

_FILTERS: dict[str, Any] = {
    "eps": 0.02,
    "depth_octaves": 16.0,
    "estimate": {
        "kernel_sigma": 0.5,
        "sigma_guide": 0.3,
        "depth_tolerance": 0.05,
        "eps": 0.02,
    },
    "reprojection": {
        "sigma_guide": 0.15,
        "sigma_space": 2.0,
        "strides": [1, 3, 5, 9],
        "radius": 1,
        "count": 4,
        "eps": 0.02,
    },
}

_DEFAULTS: dict[str, dict[str, Any]] = {
    "fusion-sr": {
        "architecture": "fusion",
        "fusion": "se-residual",
        "residual": "published",
        "buffers": ["depth", "base_color", "normal", "roughness", "metallic"],
        "down_kernel": 3,
        "demodulated": True,
        "base": "guided",
        "unjitter": True,
        "dtype": "float32",
        **_FILTERS,
    },
    "rcan": {
        "scale": 4,
        "unjitter": True,
        "dtype": "float32",
        "groups": 10,
        "blocks": 20,
        "features": 64,
        "reduction": 16,
    },
    "rrn": {"scale": 4, "unjitter": True, "dtype": "float32", "blocks": 10, "features": 128},
    "nsrr": {"previous": 4, "dtype": "float32", "depth_octaves": 16.0},
}


def upgrade(name: str, arguments: Mapping[str, Any]) -> dict[str, Any]:
    """The settings that the "arguments" of version 0.1 stand for. Unknown ones stay, for `build` to refuse.

    Args:
        name: of the method.
        arguments: as the header of the file holds them.
    """
    if name not in _DEFAULTS:
        return dict(arguments)
    settings = dict(_DEFAULTS[name])
    for key, value in arguments.items():
        if key in _LOSS or (name, key) == ("rrn", "frames"):
            continue
        if key == "color" and value in ("display", "lighting"):
            settings["demodulated"] = value == "lighting"
        elif key == "start" and value in ("nothing", "guided"):
            settings["base"] = "none" if value == "nothing" else value
        else:
            settings[_RENAMED.get(key, key)] = value
    return settings
