"""The same operations as naive NumPy loops in float64: obviously right, and slow."""
