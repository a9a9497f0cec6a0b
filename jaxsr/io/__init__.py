"""Files: OpenEXR, sequences on disk, PNG. NumPy arrays in and out; no JAX, no networks.

`exr`, `writing` and `images` need only NumPy (and OpenEXR, Pillow), so that a renderer's own Python can
write sequences; `sequence` reads them into the pytrees of `jaxsr.frames`.
"""
