"""Networks: tensors in, tensors out. One file a network, shared blocks in `layers`."""

from jaxsr.nets.fusion_sr import FusionSR
from jaxsr.nets.nsrr import NSRR
from jaxsr.nets.unet_sr import UNetSR

__all__ = ["NSRR", "FusionSR", "UNetSR"]
