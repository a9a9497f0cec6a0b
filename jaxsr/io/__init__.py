"""Files: OpenEXR, sequences on disk, archives, PNG, renders. NumPy arrays in and out; no networks.

`exr` and `writing` need only NumPy and OpenEXR, so that a renderer's own Python can write sequences; `images`
needs Pillow and jaxtyping too. The others read sequences into the pytrees of `jaxsr.frames`, whose types come
from JAX.
"""
