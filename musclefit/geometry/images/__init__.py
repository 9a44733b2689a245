"""Image grids, and images read between their voxels."""
