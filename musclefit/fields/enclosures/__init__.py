"""Rigorous bounds of fields and their derivatives over boxes, rounded outward."""
