"""musclefit: foldover-free retargeting of layered musculoskeletal models, with a report that proves it."""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING, Any

from musclefit._version import __version__

if TYPE_CHECKING:
    from musclefit.anatomy.builtin import upper_limb
    from musclefit.anatomy.mesh_rules import LayerRules
    from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
    from musclefit.geometry.meshes import TetMesh, TriMesh
    from musclefit.geometry.rigid import RigidMotion
    from musclefit.io.anatomy import read_anatomy
    from musclefit.io.formats.landmarks import read_landmarks
    from musclefit.io.formats.motions import read_motion
    from musclefit.io.rigs import find_rig, read_rig
    from musclefit.meshing.ftetwild import tetrahedralise
    from musclefit.pipeline.inspect import inspect
    from musclefit.pipeline.retarget import retarget
    from musclefit.rig.handles import Handles, StraightPath
    from musclefit.workflows.run import prepared_tets, save
    from musclefit.workflows.sequence import planned, read_frames, run_sequence

_HOMES = {
    "Anatomy": "anatomy.model",
    "Handles": "rig.handles",
    "LayerRules": "anatomy.mesh_rules",
    "RigidMotion": "geometry.rigid",
    "StraightPath": "rig.handles",
    "TetMesh": "geometry.meshes",
    "Tissue": "anatomy.model",
    "TissueKind": "anatomy.model",
    "TriMesh": "geometry.meshes",
    "find_rig": "io.rigs",
    "inspect": "pipeline.inspect",
    "prepared_tets": "workflows.run",
    "read_anatomy": "io.anatomy",
    "planned": "workflows.sequence",
    "read_frames": "workflows.sequence",
    "read_landmarks": "io.formats.landmarks",
    "read_motion": "io.formats.motions",
    "read_rig": "io.rigs",
    "retarget": "pipeline.retarget",
    "run_sequence": "workflows.sequence",
    "save": "workflows.run",
    "tetrahedralise": "meshing.ftetwild",
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
