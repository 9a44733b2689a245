"""Drives: one file each, with the record of a [drive] section, its files, and the handles and path that come of it."""

from musclefit.io.drives.cage import CageDrive
from musclefit.io.drives.joints import JointDrive
from musclefit.io.drives.landmarks import LandmarkDrive
from musclefit.io.drives.lattice import LatticeDrive
from musclefit.io.drives.opensim import OpenSimDrive
from musclefit.io.drives.skeleton import SkeletonDrive
from musclefit.io.drives.transforms import TransformDrive

__all__ = [
    "CageDrive",
    "JointDrive",
    "LandmarkDrive",
    "LatticeDrive",
    "OpenSimDrive",
    "SkeletonDrive",
    "TransformDrive",
]
