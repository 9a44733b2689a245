"""Tetrahedra: orientation, quality, topology, and how they are split and moved."""
