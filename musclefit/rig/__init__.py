"""Rigs: which tissue follows what, along which path, with which deformer and limits."""
