"""What a method asks of whoever hands it frames: the buffers that it reads, and windows to train on."""

from typing import NamedTuple


class Needs(NamedTuple):
    """Buffers that a method reads, by place and layer, such as "lr.color" or "hr.normal"."""

    rendered: frozenset[str]
    """Of a rendered frame."""
    extrapolated: frozenset[str] = frozenset()
    """Of a frame that is to be extrapolated, and of the rendered frames before it."""
    hr_jitter: bool = False
    """Whether the method accounts for jitter of the HR buffers. One that does not, and that reads more of
    them than depth and motion, is not given frames where they are jittered."""

    @property
    def refuses_hr_jitter(self) -> bool:
        """Whether frames with jittered HR buffers would come out wrong."""
        read = {need for need in self.rendered | self.extrapolated if need.startswith("hr.")}
        return not self.hr_jitter and not read <= {"hr.depth", "hr.motion"}

    def of(self, rendered: bool, extrapolating: bool = True) -> frozenset[str]:
        """What one frame must have.

        Args:
            rendered: whether this frame was rendered.
            extrapolating: whether any frame of the clip is to be extrapolated.
        """
        if not rendered:
            return self.extrapolated
        return self.rendered | self.extrapolated if extrapolating else self.rendered


class Windows(NamedTuple):
    """The windows of consecutive frames that a network trains on."""

    length: int = 1
    """Frames per window."""
    rendered: tuple[bool, ...] | None = None
    """Which of them count as rendered; None means all. The colour of the others is hidden (zero)."""
    made: tuple[int, ...] | None = (-1,)
    """Positions of the frames that the loss compares with the truth; None means all."""
    warmup: int = 0
    """Frames at the start that only fill the history; evaluation does not measure them."""
    multiple: int = 1
    """LR sides of crops are multiples of this."""
    lr_truth: bool = False
    """Whether the loss wants the LR colour of the frames that are to be made."""

    @property
    def cadence(self) -> tuple[bool, ...]:
        """`rendered`, written out."""
        return (True,) * self.length if self.rendered is None else self.rendered

    @property
    def targets(self) -> tuple[int, ...]:
        """`made` as positions from 0, in the order of time."""
        made = range(self.length) if self.made is None else self.made
        return tuple(sorted(i % self.length for i in made))
