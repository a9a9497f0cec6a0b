"""Frames from arrays that a user has: what is left out is filled in, and what is wrong is said.

`jaxsr.Frame.of` is the way in. Arrays may be NumPy's or JAX's, and are brought to one type. Values are looked
at only where they are known, not inside a function that is being compiled.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsr.errors import JaxsrError
from jaxsr.frames import FIELDS, LAYERS, Camera, Frame, GBuffer, Scale
from jaxsr.layers import MAX_JITTER, is_rigid

Images = Mapping[str, Any]


def make_frame(
    lr: Images,
    hr: Images,
    *,
    jitter: Any,
    hr_jitter: Any,
    exposure: Any,
    camera: Camera | None,
    reset: Any,
    rendered: bool,
    scale: int | None,
) -> Frame:
    """A `Frame` of these arrays; see `Frame.of`, whose `color`, `depth` and `motion` are in `lr`."""
    low, high = _images(lr, "lr"), _images(hr, "hr")
    if not rendered:
        low.pop("color", None)
    elif "color" not in low:
        raise JaxsrError(
            "a rendered frame has no colour",
            where="Frame.of",
            expected="color [h, w, 3]",
            fix="give it, or rendered=False for a frame that is to be extrapolated",
        )
    small, large = _size(low, "lr"), _size(high, "hr")
    factor = _scale(small, large, scale)
    if small is None:
        assert large is not None  # `_scale` has seen to it
        small = (large[0] // factor, large[1] // factor)
    dtype = _common_dtype([x.dtype for x in (*low.values(), *high.values())])
    low, high = ({name: _cast(x, dtype) for name, x in images.items()} for images in (low, high))
    color = low.pop("color", None)
    return Frame(
        color_linear=np.zeros((*small, 3), dtype) if color is None else color,  # type: ignore[arg-type]
        lr=_gbuffer(low),
        hr=_gbuffer(high),
        jitter_px=_jitter(jitter, dtype),
        hr_jitter_px=_hr_jitter(hr_jitter, factor, dtype),
        camera=None if camera is None else _camera(camera, dtype),
        reset=_flag(reset, "reset"),
        rendered=_flag(rendered, "rendered"),
        exposure=_exposure(exposure, dtype),
        factor=Scale(factor),
    )


def _known(x: Any) -> bool:
    """Whether the values of an array can be looked at."""
    return not isinstance(x, jax.core.Tracer)


def _common_dtype(dtypes: list[Any]) -> Any:
    """One type for a whole frame: float64 where an array has it, else float32.

    Half precision would not do: the steps compute pixel coordinates in the type of the colour.
    """
    return np.float64 if np.dtype(np.float64) in dtypes else np.float32


def _cast(x: Any, dtype: Any) -> Any:
    """The array in this type, or in the nearest that JAX allows."""
    return x.astype(jax.dtypes.canonicalize_dtype(dtype) if isinstance(x, jax.Array) else dtype)


def _images(images: Images, place: str) -> dict[str, Any]:
    """The arrays by layer, each `[h, w, c]` of floating-point numbers."""
    out: dict[str, Any] = {}
    for name, values in images.items():
        where = f"Frame.of, {place} {name}"
        if name not in ("color", *FIELDS) or (place, name) == ("hr", "color"):
            allowed = ", ".join(FIELDS) if place == "hr" else ", ".join(("color", *FIELDS))
            raise JaxsrError(f"unknown layer {name!r}", where=f"Frame.of, {place}", expected=allowed)
        if values is None:
            continue
        x = values if isinstance(values, jax.Array) else np.asarray(values)
        channels = len(LAYERS[name].letters)
        if x.ndim == 2 and channels == 1:
            x = x[..., None]
        if x.ndim != 3 or x.shape[-1] != channels or 0 in x.shape:
            raise JaxsrError(
                "wrong shape", where=where, expected=f"[h, w, {channels}]", found=list(np.shape(values))
            )
        if not jnp.issubdtype(x.dtype, jnp.floating):
            if name != "object_id":
                raise JaxsrError(
                    "not floating-point numbers",
                    where=where,
                    expected=LAYERS[name].unit or "numbers from 0 to 1",
                    found=x.dtype,
                    fix="convert it: 8-bit colour is encoded for a display, and not linear",
                )
            x = x.astype(np.float32)
        if name == "depth" and _known(x) and not bool((x > 0).all()):
            raise JaxsrError(
                "depth is not above 0 everywhere",
                where=where,
                expected="linear view depth, +inf for sky",
                found=f"smallest value {float(np.min(np.asarray(x)))}",
                fix="convert the depth buffer; give sky +inf",
            )
        out[name] = x
    return out


def _size(images: Images, place: str) -> tuple[int, int] | None:
    """(h, w) of images that must all have one size; None if there are none."""
    sizes = {name: x.shape[:2] for name, x in images.items()}
    if len(set(sizes.values())) > 1:
        found = ", ".join(f"{name} {w}x{h}" for name, (h, w) in sizes.items())
        raise JaxsrError("sizes differ", where=f"Frame.of, {place}", expected="one size", found=found)
    return next(iter(sizes.values()), None)


def _scale(small: tuple[int, int] | None, large: tuple[int, int] | None, scale: int | None) -> int:
    """HR size over LR size; 0 where the frame does not tell, and whoever runs it must."""
    if scale is not None and scale < 1:
        raise JaxsrError("bad scale", where="Frame.of, scale", expected="a whole number from 1", found=scale)
    if small is None and large is None:
        raise JaxsrError("no images", where="Frame.of", expected="at least one buffer")
    if large is None:
        return scale or 0
    if small is None:
        if scale is None:
            raise JaxsrError(
                "the size of the low resolution is not known",
                where="Frame.of",
                expected="an LR buffer, or scale",
                fix="give scale=, the HR size over the LR size",
            )
        small = (max(large[0] // scale, 1), max(large[1] // scale, 1))
    factor = max(large[0] // small[0], 1)
    if large != (small[0] * factor, small[1] * factor) or scale not in (None, factor):
        raise JaxsrError(
            "HR and LR sizes do not belong together",
            where="Frame.of",
            expected="an HR size that is a whole multiple of the LR size"
            + ("" if scale is None else f", {scale} times"),
            found=f"{large[1]}x{large[0]} and {small[1]}x{small[0]}",
        )
    return factor


def _gbuffer(images: Images) -> GBuffer:
    return GBuffer(**{FIELDS[name]: x for name, x in images.items()})


def _jitter(jitter: Any, dtype: Any) -> Any:
    if not _known(jitter):
        return jitter
    x = _numbers(jitter, dtype)
    if x.shape != (2,) or not (np.abs(x) <= MAX_JITTER).all():
        raise JaxsrError(
            "bad jitter",
            where="Frame.of, jitter",
            expected="(x, y) in LR pixels, each in [-0.5, 0.5]",
            found=np.asarray(jitter).tolist(),
            fix="convert it: texture coordinates times the LR size, NDC times half of it",
        )
    return x


def _hr_jitter(jitter: Any, scale: int, dtype: Any) -> Any:
    if not _known(jitter):
        return jitter
    x, most = _numbers(jitter, dtype), MAX_JITTER * max(scale, 1)
    if x.shape != (2,) or not (np.abs(x) <= most).all():
        raise JaxsrError(
            "bad hr_jitter",
            where="Frame.of, hr_jitter",
            expected=f"(x, y) in HR pixels, each in [-{most:g}, {most:g}], half an LR pixel",
            found=np.asarray(jitter).tolist(),
            fix="convert it: texture coordinates times the HR size, NDC times half of it",
        )
    return x


def _exposure(exposure: Any, dtype: Any) -> Any:
    if not _known(exposure):
        return exposure
    x = _numbers(exposure, dtype)
    if x.shape != () or not (np.isfinite(x) and x > 0):
        raise JaxsrError(
            "bad exposure", where="Frame.of, exposure", expected="a number above 0", found=exposure
        )
    return x


def _numbers(value: Any, dtype: Any) -> np.ndarray:
    """The value as an array; an empty one, which no check lets through, if it is not made of numbers."""
    try:
        return np.asarray(value, dtype)
    except (TypeError, ValueError):
        return np.empty(0, dtype)


def _flag(value: Any, name: str) -> Any:
    if not _known(value):
        return value
    x = np.asarray(value)
    if x.shape != () or x.dtype != bool:
        raise JaxsrError(f"bad {name}", where=f"Frame.of, {name}", expected="True or False", found=value)
    return x


def _camera(camera: Camera, dtype: Any) -> Camera:
    shapes = {"world_from_view": (4, 4), "tan_half_fov": (2,), "lens_shift": (2,)}
    values = {}
    for name, shape in shapes.items():
        x = getattr(camera, name)
        x = x if not _known(x) else np.asarray(x, dtype)
        if np.shape(x) != shape:
            raise JaxsrError(
                "wrong shape", where=f"Frame.of, camera {name}", expected=list(shape), found=list(np.shape(x))
            )
        values[name] = x
    matrix = values["world_from_view"]
    if _known(matrix) and not is_rigid(matrix.tolist()):
        raise JaxsrError(
            "the camera is not rigid",
            where="Frame.of, camera world_from_view",
            expected="a rotation and a translation, without scale or mirror image; last row 0 0 0 1",
            found=matrix.tolist(),
            fix="take the scale out of the matrix",
        )
    return Camera(**values)  # type: ignore[arg-type]
