"""What to do about a check that failed, one sentence for each kind: which key to set, or which command to run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType

from musclefit.anatomy.findings import Finding
from musclefit.flow.deformation import Status
from musclefit.validate.closeness import GAP, SLOT, THIN
from musclefit.validate.model import MeshCheck
from musclefit.vocabulary import Purpose

BEST = 'deformer.method = "rigid-bones"'
ANOTHER_BODY = f'limits.purpose = "{Purpose.ANOTHER_BODY}"'
PRIORITY = "musclefit repair IN OUT --resolve priority"

NOT_CONVERGED = {
    Status.STALLED.value: f"Set {BEST} where joints or transforms move bones, else "
    'deformer.step = "cayley", or shorten the displacements.',
    Status.OUT_OF_STEPS.value: "Set deformer.max_steps higher.",
    Status.UNSOLVED.value: "Set deformer.min_steps higher, or choose a smaller pose; where surfaces nearly touch at "
    f"rest, {PRIORITY} makes room.",
}
ENDED_EARLY = f'Run a method that is held to a rule: deformer.method = "yu2014", or {BEST}.'

LANDMARKS_LATE = "Find out why the run did not converge: landmarks reach their destinations only where it does."
LANDMARKS_MISSED = (
    "Set deformer.smoothing = 0; move the landmark along its bone where another bone occupies its target; or set "
    "limits.landmark_mm to the accuracy of the landmarks."
)

FOLDED = (
    'Set deformer.tested_at = "all-points" and surfaces.longest_edge_mm lower, so that the rule is tested closer to '
    "the place named."
)
REFUTED = (
    'Set deformer.tested_at = "all-points" and surfaces.longest_edge_mm lower, so that steps near the fold get shorter.'
)
NOT_COVERED = (
    "Leave out the listed file of points, or those of its points that are far outside the body: the map is proved "
    "for the body only."
)

INVERTED = (
    "Set mesh.refine = true and mesh.move_vertices = true, then mesh.max_rounds and mesh.max_growth higher, or "
    "tets.edge_length_fraction lower."
)
MESH_REFUTED = (
    "Set mesh.move_vertices = true, or mesh the gap between the listed tissues more finely: tets.gaps and "
    "tets.envelope_fraction."
)

BONES_BEND = f"Set {BEST}, which moves bones exactly."
BONES_BEND_FREELY = (
    f'Set bones.keep_rigid = ["*"], or keep_similar where their size may change, or {ANOTHER_BODY} where bones shall '
    "change."
)
BONES_LEFT_OUT = (
    "Name the bone in the drive (in fixed or moving of a joint, or as carried by another bone) or in bones.keep_rigid: "
    "a bone that nothing moves follows the soft tissue."
)

MUSCLES_CHANGE = f"Set {BEST}, whose field keeps volume."
MUSCLES_CHANGE_FREELY = (
    f'Set deformer.kernel = "isochoric-r3" and deformer.step = "cayley", which keep volume, or {ANOTHER_BODY} where '
    "muscles shall change."
)
MUSCLES_STILL_CHANGE = (
    "Set deformer.min_steps to twice the steps taken, surfaces.refine = true and, with rigid bones, bones.iterations "
    "to 100: what is lost falls with the square of the number of steps, and with what the field misses beside bones."
)

NEW_OVERLAP = (
    "Set surfaces.refine = true, or surfaces.chord_tolerance_mm lower; where the listed pair nearly touches at rest, "
    f"{PRIORITY} makes room."
)
MORE_OVERLAP = f"Remove the overlap at rest with {PRIORITY}, or set limits.grown_overlap_mm3 to a tolerable value."
OUT_OF_SKIN = (
    "Set surfaces.refine = true, or surfaces.chord_tolerance_mm lower; musclefit check FOLDER says what is outside the "
    "skin at rest."
)
UNCHECKED = 'Repair the surfaces listed under "Not checked" with musclefit repair IN OUT.'

REST_OVERLAP = f"Remove it with {PRIORITY}."
REST_UNUSABLE = "Repair the listed surfaces with musclefit repair IN OUT, or leave them out."
REST_OUT_OF_SKIN = "Correct the surface of the skin or of the listed tissue, or its kind with --kind NAME=KIND."

POSE_REFUSED = (
    "Stay within the largest feasible pose given; musclefit joint-range RIG reports how far each joint can turn."
)
FRAME_FAILED = "Run its pose alone with musclefit run RIG, whose report says more, or set deformer.min_steps higher."
OFF_REST = "A frame in the rest pose must equal rest: this is a bug in musclefit; please report it with report.json."
PASSED_THROUGH = "Inspect the neighbouring frames, and set --frames higher if the motion is fast there."
NOT_SETTLED = "Set --frames higher: closer frames leave less undecided between them."
NOT_EXAMINED = "Install what it needs (pip install 'musclefit[motion]') and run the sequence again: frames are kept."

NOT_VALID = "Set --limit-mm higher, or first mend the listed surfaces in a mesh editor."
TOO_FAR = "Set --limit-mm to a tolerable distance, or first mend the listed surface in a mesh editor."
CHANGED_MUCH = (
    "Inspect the listed tissue; if it is right, set --max-change-percent higher; otherwise give it another kind "
    "(--kind name=other), let other tissues give way (--rule, --resolve split), or first mend it in a mesh editor."
)
FELL_APART = "Inspect the listed tissue; give it another kind (--kind name=bone), or change --rule or --clearance-mm."
STILL_MEET = "Run musclefit repair once more on its output, or leave out the smaller tissue of the listed pair."

REPAIRED = "Remove it with musclefit repair IN OUT."
CORRECTED = "It was corrected for this report alone; musclefit repair IN OUT writes the corrected surface."
FINDINGS: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("self-crossing", "self-touching", "non-manifold", "zero-area"), REPAIRED),
        **dict.fromkeys(
            ("merged-vertices", "repeated-vertices", "repeated-faces", "turned-faces", "inside-out"), CORRECTED
        ),
        "pieces": "Save pieces that are different tissues as files of their own; musclefit repair IN OUT removes stray "
        "ones below --stray-percent of the volume.",
        "cavities": "Keep them if the tissue is hollow there; otherwise delete the inner pieces in a mesh editor.",
        "nested": "If the inner pieces are cavities, musclefit repair IN OUT turns them inwards; otherwise delete them "
        "in a mesh editor.",
        "unused-vertices": "They change no result; export the surface without them if they are not wanted.",
        "cut-polygons": "Nothing need be done; export triangles to choose yourself how they are cut.",
        "unknown-kind": "Give its kind with --kind NAME=KIND, or in [anatomy.kinds] of a rig.",
        "not-read": "Move these elsewhere; save surfaces among them as PLY, STL, OBJ or VTP.",
        THIN: "Thicken the wall in a mesh editor, or set --thinnest-mm lower.",
        SLOT: "Widen or fill the slot in a mesh editor, or set --thinnest-mm lower.",
        GAP: "Widen the gap with musclefit repair IN OUT --resolve priority --clearance-mm, or set "
        "--smallest-gap-mm lower.",
    }
)
"""What to do about what is found in surfaces, by the finding's code."""


def with_next_steps(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings, each with what to do about it where its code is in ``FINDINGS``."""
    return tuple(replace(found, next_step=FINDINGS.get(found.code, found.next_step)) for found in findings)


def after_findings(code: str) -> str:
    """Where findings of a code that ``check`` was to fail on were made."""
    return (
        f"{FINDINGS[code]} To allow it, remove {code} from --fail-on."
        if code not in (THIN, SLOT, GAP)
        else FINDINGS[code]
    )


def after_ending(status: str) -> str:
    """Where a run ended before its destination."""
    return NOT_CONVERGED.get(status, ENDED_EARLY)


def after_inverted_tets(found: MeshCheck) -> str:
    """Where tetrahedra came out inverted; names the bound that ended their mending."""
    stopped = found.refinement.stopped if found.refinement is not None else ""
    return f"{INVERTED.removesuffix('.')}; mending stopped at {stopped}." if stopped else INVERTED
