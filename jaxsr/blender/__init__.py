"""Rendering with Blender, which runs in a process of its own."""
