"""Networks: tensors in, tensors out. One file per network; `blocks` has what they share."""

from jaxsr.nets.fusion_sr import FusionSR
from jaxsr.nets.nsrr import NSRR
from jaxsr.nets.rcan import RCAN
from jaxsr.nets.rrn import RRN
from jaxsr.nets.unet_sr import UNetSR

__all__ = ["NSRR", "RCAN", "RRN", "FusionSR", "UNetSR"]
