"""What to do about a check that failed, one sentence for each kind: which key to set, or which command to run."""

from __future__ import annotations

from musclefit.flow.deformation import Status
from musclefit.validate.model import MeshCheck
from musclefit.vocabulary import Purpose

BEST = 'deformer.method = "rigid-bones"'
ANOTHER_BODY = f'limits.purpose = "{Purpose.ANOTHER_BODY}"'
PRIORITY = "musclefit repair IN OUT --resolve priority"

NOT_CONVERGED = {
    Status.STALLED.value: f"Set {BEST} where joints or transforms move bones, else "
    'deformer.step = "cayley", or send the handles less far.',
    Status.OUT_OF_STEPS.value: "Set deformer.max_steps higher.",
    Status.UNSOLVED.value: "Set deformer.min_steps higher, or choose a smaller pose; where surfaces nearly touch at "
    f"rest, {PRIORITY} makes room.",
}
ENDED_EARLY = f'Run a method that is held to a rule: deformer.method = "yu2014", or {BEST}.'

LANDMARKS_LATE = "Settle why the run did not converge: landmarks arrive where it does."
LANDMARKS_MISSED = (
    "Set deformer.smoothing = 0; move the landmark along its bone where it lies on another bone, which cannot be where "
    "it is at the same time; or set limits.landmark_mm to what the landmarks are worth."
)

FOLDED = (
    'Set deformer.tested_at = "all-points" and surfaces.longest_edge_mm lower, so that the rule is tested closer to '
    "the place named."
)
REFUTED = (
    'Set deformer.tested_at = "all-points" and surfaces.longest_edge_mm lower, so that steps near the fold get shorter.'
)
NOT_COVERED = (
    "Leave out the file of points named, or those of its points that are far outside the body: the map is proved for "
    "the body, and not there."
)

INVERTED = (
    "Set mesh.refine = true and mesh.move_vertices = true, then mesh.max_rounds and mesh.max_growth higher, or "
    "tets.edge_length_fraction lower."
)
MESH_REFUTED = (
    "Set mesh.move_vertices = true, or mesh the gap between the tissues named more finely: tets.gaps and "
    "tets.envelope_fraction."
)

BONES_BEND = f"Set {BEST}, which moves bones exactly."
BONES_BEND_FREELY = (
    f'Set bones.keep_rigid = ["*"], or keep_similar where their size may change, or {ANOTHER_BODY} where bones shall '
    "change."
)
BONES_LEFT_OUT = (
    "Name the bone in the drive (in fixed or moving of a joint, or as carried by another bone) or in bones.keep_rigid: "
    "what nothing moves follows the soft tissue."
)

MUSCLES_CHANGE = f"Set {BEST}, whose field keeps volume."
MUSCLES_CHANGE_FREELY = (
    f'Set deformer.kernel = "isochoric-r3" and deformer.step = "cayley", which keep volume, or {ANOTHER_BODY} where '
    "muscles shall change."
)
MUSCLES_STILL_CHANGE = (
    "Set deformer.min_steps to twice the steps taken, and surfaces.refine = true: what is lost of a volume falls with "
    "the square of the steps."
)

NEW_OVERLAP = (
    "Set surfaces.refine = true, or surfaces.chord_tolerance_mm lower; where the pair named nearly touches at rest, "
    f"{PRIORITY} makes room."
)
MORE_OVERLAP = (
    f"Take away with {PRIORITY} what the tissues share at rest, or set limits.grown_overlap_mm3 to what is tolerable."
)
OUT_OF_SKIN = (
    "Set surfaces.refine = true, or surfaces.chord_tolerance_mm lower; musclefit check FOLDER says what is outside the "
    "skin at rest."
)
UNCHECKED = 'Mend the surfaces named under "Not checked" with musclefit repair IN OUT.'

REST_OVERLAP = f"Take it away with {PRIORITY}."
REST_UNUSABLE = "Mend the surfaces named with musclefit repair IN OUT, or leave them out."
REST_FAULTS = "Mend the surfaces named with musclefit repair IN OUT, or leave this out of --fail-on."
REST_OUT_OF_SKIN = "Give the skin or the tissue named another surface, or another kind with --kind NAME=KIND."

POSE_REFUSED = "Keep to the largest feasible pose named; musclefit joint-range RIG says how far each joint can turn."
FRAME_FAILED = (
    "Run its pose by itself with musclefit run RIG, whose report says more, or set deformer.min_steps higher."
)
OFF_REST = (
    "A frame in the rest pose is made of nothing but rest: this is a fault of musclefit; file it with report.json."
)
PASSED_THROUGH = "Look at the frames beside it, and set --frames higher where the motion is fast there."
NOT_SETTLED = "Set --frames higher: closer frames leave less to settle between them."
NOT_EXAMINED = "Install what it needs (pip install 'musclefit[motion]') and run the sequence again: frames are kept."

NOT_VALID = "Set --limit-mm higher, or mend the surfaces named in a mesh editor first."
TOO_FAR = "Set --limit-mm to a distance that is tolerable, or mend the surface named in a mesh editor first."
CHANGED_MUCH = (
    "Look at the tissue named; where it is right, set --max-change-percent higher, else give it another kind "
    "(--kind name=other), let others lose (--rule, --resolve split), or mend it in a mesh editor first."
)
FELL_APART = "Look at the tissue named; give it another kind (--kind name=bone), or set --rule or --clearance-mm anew."
STILL_MEET = "Run musclefit repair on its output once more, or leave out the smaller tissue of the pair named."


def after_ending(status: str) -> str:
    """Where a run ended before its destination."""
    return NOT_CONVERGED.get(status, ENDED_EARLY)


def after_inverted_tets(found: MeshCheck) -> str:
    """Where tetrahedra came out inverted; names the bound that ended their mending."""
    stopped = found.refinement.stopped if found.refinement is not None else ""
    return f"{INVERTED.removesuffix('.')}; mending was ended by {stopped}." if stopped else INVERTED
