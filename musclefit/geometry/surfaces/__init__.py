"""Triangle surfaces: how they hang together, what is wrong with them, and how they are cut, split and mended."""
