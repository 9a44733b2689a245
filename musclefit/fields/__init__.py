"""Displacement fields fitted to handle displacements: value, gradient, rigorous bounds."""
