"""musclefit: foldover-free retargeting of layered musculoskeletal models, with a report that proves it.

One function for each command, with the command's own defaults: `run`, `sequence`, `check`, `check_mesh`, `repair`,
`cage`, `fit_body`, `fit_measures`, `fit_joint`, `from_labels`, `joint_range`, `label_surfaces`, `warp_image`,
`warp_field`, `warp_deck`, `export`, `export_motion`, `export_osim`, `import_osim`, `architecture`, `febio_model` and
`init`. They and what they give back are stable, as are the other names of this module; what is in the rooms below may
change with any version.
"""

from importlib import import_module as _import_module
from typing import TYPE_CHECKING, Any

from musclefit._version import __version__

if TYPE_CHECKING:
    from musclefit.anatomy.builtin import upper_limb
    from musclefit.anatomy.mesh_rules import LayerRules
    from musclefit.anatomy.model import Anatomy, Tissue, TissueKind
    from musclefit.errors import (
        FieldError,
        InputError,
        LandmarkError,
        MeshError,
        MusclefitError,
        NotConvergedError,
        RigError,
    )
    from musclefit.fields.kernels.registry import register as register_kernel
    from musclefit.geometry.meshes import TetMesh, TriMesh
    from musclefit.geometry.rigid import RigidMotion
    from musclefit.io.anatomy import read_anatomy
    from musclefit.io.formats.landmarks import read_landmarks
    from musclefit.io.formats.motions import read_motion
    from musclefit.io.given_fibres import FibreFiles
    from musclefit.io.rigs import find_rig, read_rig
    from musclefit.meshing.ftetwild import tetrahedralise
    from musclefit.pipeline.inspect import inspect
    from musclefit.pipeline.retarget import retarget
    from musclefit.rig.handles import Handles, StraightPath
    from musclefit.vocabulary import Claim, Unit
    from musclefit.workflows.architecture import architecture
    from musclefit.workflows.batch import batch
    from musclefit.workflows.cage import cage
    from musclefit.workflows.check import check
    from musclefit.workflows.check_mesh import check_mesh
    from musclefit.workflows.collect import collect
    from musclefit.workflows.compare import compare
    from musclefit.workflows.export import export
    from musclefit.workflows.export_motion import export_motion
    from musclefit.workflows.export_osim import export_osim
    from musclefit.workflows.febio_model import febio_model
    from musclefit.workflows.fit_body import fit_body
    from musclefit.workflows.fit_joint import fit_joint
    from musclefit.workflows.fit_measures import fit_measures
    from musclefit.workflows.from_labels import from_labels
    from musclefit.workflows.import_osim import import_osim
    from musclefit.workflows.init import init
    from musclefit.workflows.joint_range import joint_range
    from musclefit.workflows.label_surfaces import label_surfaces
    from musclefit.workflows.render import render
    from musclefit.workflows.repair import repair
    from musclefit.workflows.run import prepared_tets, run, save
    from musclefit.workflows.sequence import run_sequence, sequence
    from musclefit.workflows.sequence_frames import read_frames
    from musclefit.workflows.sequence_plan import planned
    from musclefit.workflows.view import view
    from musclefit.workflows.warp_deck import warp_deck
    from musclefit.workflows.warp_field import warp_field
    from musclefit.workflows.warp_image import warp_image

_HOMES = {
    "Anatomy": "anatomy.model",
    "Claim": "vocabulary",
    "FibreFiles": "io.given_fibres",
    "FieldError": "errors",
    "Handles": "rig.handles",
    "InputError": "errors",
    "LandmarkError": "errors",
    "LayerRules": "anatomy.mesh_rules",
    "MeshError": "errors",
    "MusclefitError": "errors",
    "NotConvergedError": "errors",
    "RigError": "errors",
    "RigidMotion": "geometry.rigid",
    "StraightPath": "rig.handles",
    "TetMesh": "geometry.meshes",
    "Tissue": "anatomy.model",
    "TissueKind": "anatomy.model",
    "TriMesh": "geometry.meshes",
    "Unit": "vocabulary",
    "architecture": "workflows.architecture",
    "batch": "workflows.batch",
    "cage": "workflows.cage",
    "check": "workflows.check",
    "check_mesh": "workflows.check_mesh",
    "collect": "workflows.collect",
    "compare": "workflows.compare",
    "export": "workflows.export",
    "export_motion": "workflows.export_motion",
    "export_osim": "workflows.export_osim",
    "febio_model": "workflows.febio_model",
    "find_rig": "io.rigs",
    "fit_body": "workflows.fit_body",
    "fit_joint": "workflows.fit_joint",
    "fit_measures": "workflows.fit_measures",
    "from_labels": "workflows.from_labels",
    "import_osim": "workflows.import_osim",
    "init": "workflows.init",
    "inspect": "pipeline.inspect",
    "joint_range": "workflows.joint_range",
    "label_surfaces": "workflows.label_surfaces",
    "planned": "workflows.sequence_plan",
    "prepared_tets": "workflows.run",
    "read_anatomy": "io.anatomy",
    "read_frames": "workflows.sequence_frames",
    "read_landmarks": "io.formats.landmarks",
    "read_motion": "io.formats.motions",
    "read_rig": "io.rigs",
    "register_kernel": "fields.kernels.registry",
    "render": "workflows.render",
    "repair": "workflows.repair",
    "retarget": "pipeline.retarget",
    "run": "workflows.run",
    "run_sequence": "workflows.sequence",
    "save": "workflows.run",
    "sequence": "workflows.sequence",
    "tetrahedralise": "meshing.ftetwild",
    "upper_limb": "anatomy.builtin",
    "view": "workflows.view",
    "warp_deck": "workflows.warp_deck",
    "warp_field": "workflows.warp_field",
    "warp_image": "workflows.warp_image",
}

_NAMED_OTHERWISE = {"register_kernel": "register"}

__all__ = [
    "Anatomy",
    "Claim",
    "FibreFiles",
    "FieldError",
    "Handles",
    "InputError",
    "LandmarkError",
    "LayerRules",
    "MeshError",
    "MusclefitError",
    "NotConvergedError",
    "RigError",
    "RigidMotion",
    "StraightPath",
    "TetMesh",
    "Tissue",
    "TissueKind",
    "TriMesh",
    "Unit",
    "__version__",
    "architecture",
    "batch",
    "cage",
    "check",
    "check_mesh",
    "collect",
    "compare",
    "export",
    "export_motion",
    "export_osim",
    "febio_model",
    "find_rig",
    "fit_body",
    "fit_joint",
    "fit_measures",
    "from_labels",
    "import_osim",
    "init",
    "inspect",
    "joint_range",
    "label_surfaces",
    "planned",
    "prepared_tets",
    "read_anatomy",
    "read_frames",
    "read_landmarks",
    "read_motion",
    "read_rig",
    "register_kernel",
    "render",
    "repair",
    "retarget",
    "run",
    "run_sequence",
    "save",
    "sequence",
    "tetrahedralise",
    "upper_limb",
    "view",
    "warp_deck",
    "warp_field",
    "warp_image",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import musclefit`` stays quick."""
    if name not in _HOMES:
        raise AttributeError(f"module 'musclefit' has no attribute {name!r}")
    return getattr(_import_module(f"musclefit.{_HOMES[name]}"), _NAMED_OTHERWISE.get(name, name))


def __dir__() -> list[str]:
    """The public names."""
    return sorted(__all__)
