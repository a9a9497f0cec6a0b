"""jaxsr: super-resolution and frame extrapolation for rendered images, guided by G-buffers, in JAX."""

__version__ = "0.1.0"
