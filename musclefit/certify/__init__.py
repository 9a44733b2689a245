"""Proofs that a map or a mesh does not fold; they recompute everything from fields, vertices and tets."""
