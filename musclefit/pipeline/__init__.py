"""The order of the stages: retarget, check; no formula, no file."""
