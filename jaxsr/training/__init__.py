"""Training: one readable loop (`loop.train`) over any method with a network and a loss."""

from jaxsr.training.config import TrainConfig
from jaxsr.training.loop import train

__all__ = ["TrainConfig", "train"]
