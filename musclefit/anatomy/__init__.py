"""Layered anatomy: tissues, what was found when reading them, and their tetrahedra."""
