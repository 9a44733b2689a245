"""Dirty or overlapping surfaces made into surfaces that bound solids and share no point."""
