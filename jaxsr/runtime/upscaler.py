"""A method on frames of one's own, one by one: `up = jaxsr.load("guided-taau", scale=4)`."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsr.errors import JaxsrError
from jaxsr.frames import FIELDS, Frame, GBuffer, Scale
from jaxsr.layers import DERIVED, needed
from jaxsr.methods.base import Needs, State
from jaxsr.ops import hr_from_lr
from jaxsr.runtime.load import LoadedMethod, find_method


class Upscaler:
    """A method with its weights, compiled. Made by `jaxsr.load`.

    Each kind of frame, rendered or not, is compiled once per size; memory does not grow with the number of
    frames. The state that a call is given is consumed (donated): use the one that it returns.

    Attributes:
        name, summary: of the method.
        scale: HR size over LR size.
        needs: buffers that the method reads: `needs.rendered` and `needs.extrapolated`.
        method, net: the pure step functions and the parameters, for code that compiles them itself, perhaps
            inside `jax.lax.scan`: `jaxsr.methods.base.step(up.method)`.
    """

    def __init__(self, loaded: LoadedMethod, scale: int):
        self.method, self.scale = loaded.method, scale
        self.net = jax.device_put(loaded.net)
        self._init = jax.jit(loaded.method.init)
        self._expected: dict[Any, Any] = {}
        self._steps = {
            True: jax.jit(loaded.method.upscale, donate_argnums=1),
            False: jax.jit(loaded.method.extrapolate, donate_argnums=1),
        }

    @property
    def name(self) -> str:
        return self.method.name

    @property
    def summary(self) -> str:
        return self.method.summary

    @property
    def needs(self) -> Needs:
        return self.method.needs

    def __repr__(self) -> str:
        return f"<{self.name} x{self.scale}: {self.summary}>"

    def init(self, frame: Frame) -> State:
        """The empty state for frames like this one, which must be rendered.

        Raises:
            JaxsrError: the frame was not rendered, has another scale, or lacks a buffer.
        """
        if not bool(frame.rendered):
            raise JaxsrError(
                "the first frame is not rendered", where=self.name, fix="start at a rendered one"
            )
        return self._init(self._prepared(frame, True))

    def __call__(self, frame: Frame, state: State) -> tuple[Float[Array, "H W 3"], State]:
        """The HR linear colour of one frame, and the next state. At a reset the state begins anew.

        Raises:
            JaxsrError: the frame has another scale, lacks a buffer, has another size than the state, or is
                both a reset and not rendered.
        """
        rendered = bool(frame.rendered)
        prepared = self._prepared(frame, rendered)
        if bool(frame.reset):
            if not rendered:
                raise JaxsrError("a frame that begins anew is not rendered", where=self.name, fix="render it")
            state = self._init(prepared)
        self._check_state(state, prepared)
        state, image = self._steps[rendered](self.net, state, prepared)
        return image, state

    def _check_state(self, state: State, frame: Frame) -> None:
        """See that the state fits the frame: it was made for frames of this size with these buffers."""
        if any(isinstance(x, jax.Array) and x.is_deleted() for x in jax.tree.leaves(state)):
            raise JaxsrError(
                "the state was used already", where=self.name, fix="use the state that the last call returned"
            )
        key = jax.tree.structure(frame), tuple(map(jnp.shape, jax.tree.leaves(frame)))
        if key not in self._expected:
            self._expected[key] = _shapes(jax.eval_shape(self.method.init, frame))
        if _shapes(state) != self._expected[key]:
            raise JaxsrError(
                "the state does not fit the frame",
                where=self.name,
                expected=f"a state for {frame.size[1]}x{frame.size[0]} with the buffers of this frame",
                fix="call init for frames of another size, and give all frames the same buffers",
            )

    def _prepared(self, frame: Frame, rendered: bool) -> Frame:
        """The frame with the buffers that the method reads and no others, derived where that is possible."""
        frame = self._scaled(frame)
        needs = self.needs.of(rendered)
        lr, hr = frame.lr, frame.hr
        if self.scale == 1:  # the images are the same
            lr, hr = _filled(lr, hr), _filled(hr, lr)
        lacking = [
            name for name in sorted(DERIVED) if f"hr.{name}" in needs and getattr(hr, FIELDS[name]) is None
        ]
        if lacking and lr.depth_linear is not None and (lacking == ["depth"] or lr.motion_px is not None):
            depth, motion = _hr_from_lr(lr.depth_linear, lr.motion_px, frame.jitter_px, self.scale)
            made = {"depth": depth, "motion": motion}
            hr = hr._replace(**{FIELDS[name]: made[name] for name in lacking})
        small, large = _only(lr, needed(needs, "lr")), _only(hr, needed(needs, "hr"))
        missing = [f"lr.{n}" for n in _missing(small, needs, "lr")]
        missing += [f"hr.{n}" for n in _missing(large, needs, "hr")]
        if missing and rendered:  # those that only frames without colour want are no error yet
            missing = [name for name in missing if name in self.needs.rendered]
        if missing:
            raise JaxsrError(
                f"the frame lacks {', '.join(missing)}",
                where=self.name,
                expected=", ".join(sorted(self.needs.rendered if rendered else self.needs.extrapolated)),
                fix="give them to Frame.of, or choose a method that does without",
            )
        if self.needs.refuses_hr_jitter and np.any(np.asarray(frame.hr_jitter_px)):
            raise JaxsrError(
                "the method does not account for jittered HR buffers",
                where=self.name,
                expected="hr_jitter 0",
                found=np.asarray(frame.hr_jitter_px).tolist(),
                fix="use guided-taau, or HR buffers without jitter",
            )
        return frame._replace(lr=small, hr=large)

    def _scaled(self, frame: Frame) -> Frame:
        """The frame with its scale: a frame of LR buffers alone does not know it."""
        if frame.scale not in (0, self.scale):
            raise JaxsrError(
                "the frame has another scale", where=self.name, expected=self.scale, found=frame.scale
            )
        return frame._replace(factor=Scale(self.scale))


def _shapes(tree: Any) -> Any:
    return jax.tree.structure(tree), tuple(map(jnp.shape, jax.tree.leaves(tree)))


_hr_from_lr = jax.jit(hr_from_lr, static_argnames=("scale",))


def _filled(buffers: GBuffer, others: GBuffer) -> GBuffer:
    """The buffers, and where they are None the others."""
    lacking = [field for field in GBuffer._fields if getattr(buffers, field) is None]
    return buffers._replace(**{field: getattr(others, field) for field in lacking})


def _only(buffers: GBuffer, layers: frozenset[str]) -> GBuffer:
    return GBuffer(**{f: getattr(buffers, f) for n, f in FIELDS.items() if n in layers})


def _missing(buffers: GBuffer, needs: frozenset[str], place: str) -> list[str]:
    wanted = needed(needs, place) - {"color"}
    return sorted(n for n in wanted if getattr(buffers, FIELDS[n]) is None)


def load(name: str, scale: int) -> Upscaler:
    """A method ready to run on frames.

    Args:
        name: of a method ("taau", "guided-taau"), of weights that ship with jaxsr ("fusion-sr"), or the path
            of a file of weights, `*.safetensors`.
        scale: HR size over LR size.

    Raises:
        JaxsrError: there is no such method, or no weights of it for this scale.
    """
    if isinstance(scale, bool) or not isinstance(scale, int) or scale < 1:
        raise JaxsrError("bad scale", where="load", expected="a whole number from 1", found=scale)
    return Upscaler(find_method(str(name), scale), scale)


__all__ = ["Upscaler", "load"]
