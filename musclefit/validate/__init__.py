"""Checks of a deformed anatomy: overlap, volume, rigidity, tissue outside skin."""
