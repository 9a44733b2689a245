"""Tetrahedralisation of layered anatomies by fTetWild, in a process of its own, and the cache of its results."""
