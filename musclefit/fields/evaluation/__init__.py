"""Compiled sums that fields are evaluated by."""
