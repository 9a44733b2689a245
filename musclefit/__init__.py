"""musclefit: foldover-free retargeting of layered musculoskeletal models, with a report that proves it."""

from importlib import import_module as _import_module
from importlib.metadata import version as _version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from musclefit.anatomy.builtin import upper_limb
    from musclefit.anatomy.layers import LayerRules
    from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
    from musclefit.geometry.meshes import TetMesh, TriMesh
    from musclefit.geometry.rigid import RigidMotion
    from musclefit.io.ftetwild import tetrahedralise
    from musclefit.io.landmarks import read_landmarks
    from musclefit.io.motions import read_motion
    from musclefit.io.rigs import find_rig, read_rig
    from musclefit.io.runs import prepared_tets, save
    from musclefit.io.sequences import planned, read_frames, run_sequence
    from musclefit.io.surfaces import read_anatomy
    from musclefit.pipeline.inspect import inspect
    from musclefit.pipeline.retarget import retarget
    from musclefit.rig.handles import Handles, StraightPath

__version__ = _version("musclefit")

_HOMES = {
    "Anatomy": "anatomy.model",
    "Handles": "rig.handles",
    "LayerRules": "anatomy.layers",
    "RigidMotion": "geometry.rigid",
    "StraightPath": "rig.handles",
    "TetMesh": "geometry.meshes",
    "Tissue": "anatomy.model",
    "TissueKind": "anatomy.model",
    "TriMesh": "geometry.meshes",
    "find_rig": "io.rigs",
    "inspect": "pipeline.inspect",
    "prepared_tets": "io.runs",
    "read_anatomy": "io.surfaces",
    "planned": "io.sequences",
    "read_frames": "io.sequences",
    "read_landmarks": "io.landmarks",
    "read_motion": "io.motions",
    "read_rig": "io.rigs",
    "retarget": "pipeline.retarget",
    "run_sequence": "io.sequences",
    "save": "io.runs",
    "tetrahedralise": "io.ftetwild",
    "upper_limb": "anatomy.builtin",
}

__all__ = [
    "Anatomy",
    "Handles",
    "LayerRules",
    "RigidMotion",
    "StraightPath",
    "TetMesh",
    "Tissue",
    "TissueKind",
    "TriMesh",
    "__version__",
    "find_rig",
    "inspect",
    "planned",
    "prepared_tets",
    "read_anatomy",
    "read_frames",
    "read_landmarks",
    "read_motion",
    "read_rig",
    "retarget",
    "run_sequence",
    "save",
    "tetrahedralise",
    "upper_limb",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import musclefit`` stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module 'musclefit' has no attribute {name!r}")
    return getattr(_import_module(f"musclefit.{_HOMES[name]}"), name)
