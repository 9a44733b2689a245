"""The documented JSON Schema (draft 2020-12) of the reports; knows keys, meanings and units, no report."""

from __future__ import annotations

from typing import Any

from musclefit.report.model import SCHEMA_VERSION
from musclefit.vocabulary import Claim, Purpose

Schema = dict[str, Any]

_DIALECT = "https://json-schema.org/draft/2020-12/schema"


def report_schema() -> Schema:
    """JSON Schema of ``report.json`` as written by a run."""
    side = _side_properties()
    properties = {
        "schema_version": {"const": SCHEMA_VERSION, "description": "Version of these keys and their meaning."},
        "title": _text("Title of the rig."),
        **side,
        "limits": _limits(),
        "tets": {
            "description": "The tetrahedra at rest; null where none were made.",
            "oneOf": [_tets(), {"type": "null"}],
        },
        "joint_ranges": _list(
            joint_range_schema(), "How far the joints that the pose turns can turn; no part of the verdict."
        ),
        "findings": _list(_finding(), "What was found in the input; no part of the verdict."),
        "baseline": {
            "description": "The same keys for the same handles in one shot, held against the same limits; null where "
            "that was not run. It never changes the verdict.",
            "oneOf": [_record(side, "One method's outcome."), {"type": "null"}],
        },
        "paper_loop": {
            "description": "The same keys for the same handles by the loop of Yu et al. 2014, held against the same "
            "limits; null where the result is that loop's own, or it was not run. It never changes the verdict.",
            "oneOf": [_record(side, "One method's outcome."), {"type": "null"}],
        },
        "certificate_cost": {
            "description": "What the proof that the map is one-to-one took beside the deformation, wall time; null "
            "where none was tried.",
            "oneOf": [_certificate_cost(), {"type": "null"}],
        },
        **_run_properties(),
        "files": _files(),
        "surfaces": _list(_surface(), "Which files hold which tissue."),
    }
    required = [key for key in properties if key not in ("files", "surfaces")]
    return _document("Report of one musclefit run", properties, required)


def mesh_report_schema() -> Schema:
    """JSON Schema of the report of an anatomy as it is."""
    tissue = {
        "name": _text("Name of the tissue."),
        "kind": _kind(),
        "vertices": _count("Vertices of its surface."),
        "triangles": _count("Triangles of its surface."),
        "volume_mm3": _number("Signed enclosed volume, mm³."),
        "outside_skin_mm3": _number("Volume outside the skin, mm³; null where there is no skin, and for the skin."),
    }
    pair = {
        "a": _text("One tissue."),
        "b": _text("The other tissue."),
        "volume_mm3": _number("Volume of their intersection, mm³."),
    }
    properties = {
        "schema_version": {"const": SCHEMA_VERSION, "description": "Version of these keys and their meaning."},
        "title": _text("What was inspected."),
        "verdict": _verdict(),
        "frame": _text("The coordinate frame in words."),
        "tissues": _list(_record(tissue, "One tissue."), "All tissues, outermost first."),
        "overlaps": _list(_record(pair, "Two tissues that overlap."), "Overlapping pairs, largest first."),
        "overlap_total_mm3": _number("Overlap volume summed over all pairs, mm³."),
        "pairs_tested": _count("Pairs of tissues tested for overlap."),
        "not_checked": _not_checked(),
        "findings": _list(_finding(), "What was found in the input."),
        "checks": _checks(),
        **_run_properties(),
        "files": _files(),
    }
    return _document("Report of one musclefit inspection", properties, [key for key in properties if key != "files"])


def _side_properties() -> Schema:
    return {
        "verdict": _verdict(),
        "status": _text('"converged", or how the run ended instead, in words.'),
        "steps": _count("Steps taken."),
        "method": _text("The method in words."),
        "landmarks": _landmarks(),
        "map": _map(),
        "mesh": {
            "description": "The deformed tetrahedra; null where none were made.",
            "oneOf": [_mesh(), {"type": "null"}],
        },
        "steps_rejected": _count("Stretches of the path that were tried and cut shorter."),
        "edges_split": _count("Edges of the surfaces that were split because the map bends them."),
        "edges_left_bent": _count("Edges still bent beyond the tolerance."),
        "crossings_left": _count("Pairs of triangles that come to cross and that halving does not part."),
        "steps_returned": _count("Times that points between those tested took the march back to a step."),
        "bones": {
            "description": "The field at the bones; null where bones are not held rigid.",
            "oneOf": [_bones(), {"type": "null"}],
        },
        "tissues": _list(_tissue(), "All tissues, outermost first."),
        "overlaps": _list(_overlap(), "Overlapping pairs, largest first."),
        "overlap_total": _record(_overlap_volumes(), "Overlap volumes summed over all pairs."),
        "bone_overlaps": _list(
            _bone_overlap(),
            "What held bones share by their rigid motions alone, known before the deformation: below the limits of a "
            "collision, and no part of what it introduces.",
        ),
        "pairs_tested": _count("Pairs of tissues tested for overlap."),
        "not_checked": _not_checked(),
        "checks": _checks(),
    }


def joint_range_schema() -> Schema:
    """JSON Schema of one coordinate's free range, all others at rest."""
    end = {
        "degrees": _number("How far it can turn to this side, degrees; short of the true end by the resolution."),
        "ended_by": {
            "enum": ["bones", "limit", "not met"],
            "description": "Bones that run into each other, the limit stated for it, or nothing as far as 180 degrees.",
        },
        "beyond": {
            "description": "The bones that end it, one step beyond; null where none do.",
            "oneOf": [_bone_overlap(), {"type": "null"}],
        },
    }
    limits = {
        "type": "array",
        "items": {"type": ["number", "null"]},
        "minItems": 2,
        "maxItems": 2,
        "description": "The limits stated for it, degrees; null where there is none.",
    }
    properties = {
        "joint": _text("Name of the coordinate, as a pose names it."),
        "low": _record(end, "Where its range ends below rest."),
        "high": _record(end, "Where its range ends above rest."),
        "limits_deg": limits,
        "step_deg": _number("Bones were tested at least this often, degrees."),
        "resolution_deg": _number("How finely an end was found, degrees."),
        "untested": _list(_text("Name of a bone."), "Bones that were left out because they are no solids."),
    }
    return _record(properties, "One coordinate.")


def _bone_overlap() -> Schema:
    properties = {
        "a": _text("One bone."),
        "b": _text("The other."),
        "rest_mm3": _number("Volume of their intersection at rest, mm³."),
        "posed_mm3": _number("Volume of their intersection where their motions put them, mm³."),
        "beyond_mm3": _number("Of it, what is beyond the intersection at rest carried along, mm³."),
        "beyond_limit_mm3": _number("How much of that is no collision yet, by the size of the smaller bone, mm³."),
        "depth_mm": _number("How deep its places lie below the surface of either bone, at most, mm."),
        "depth_limit_mm": _number("How deep is no collision yet, by the size of the smaller bone, mm."),
    }
    return _record(properties, "Two bones.")


def _certificate_cost() -> Schema:
    properties = {
        "certificate_s": _number("Seconds of the proof of the result's map."),
        "deformation_s": _number("Seconds of the deformation itself."),
        "share": _number("The first over the second."),
    }
    return _record(properties, "Cost of the certificate.")


def _limits() -> Schema:
    properties = {
        "purpose": {
            "enum": [purpose.value for purpose in Purpose],
            "description": "What the limits are for: another pose of the same body, or another body, whose bones and "
            "muscles are told as measured unless the rig limits them.",
        },
        "because": _text("Why they are for this purpose."),
        "landmark_mm": _number("Landmark error, mm."),
        "bone_rigidity_mm": _number(
            "Bone off rigid, mm; null for no limit, which bones that are held or kept have all the same."
        ),
        "muscle_volume_percent": _number("Muscle volume change, percent; null for no limit."),
        "introduced_overlap_mm3": _number("Introduced overlap, mm³."),
        "grown_overlap_mm3": _number("Grown overlap, mm³."),
        "introduced_outside_skin_mm3": _number("Introduced volume outside the skin, mm³."),
        "inverted_tets": _count("Inverted tetrahedra."),
    }
    return _record(properties, "What the result is held against.")


def _run_properties() -> Schema:
    return {
        "timings_s": {
            "type": "object",
            "description": "Wall time by stage, seconds.",
            "additionalProperties": {"type": ["number", "null"]},
        },
        "peak_memory_mb": _number("Largest resident memory of the process, MB (10⁶ bytes); null where unknown."),
        "provenance": {"type": "object", "description": "Versions, hashes of the input files, and settings."},
    }


def _landmarks() -> Schema:
    properties = {
        "count": _count("Landmarks driving the deformation."),
        "max_error_mm": _number("Largest distance of a landmark from its destination, mm."),
        "worst": _text("Name of the landmark with that distance."),
    }
    return _record(properties, "How far the landmarks are from their destinations.")


def _map() -> Schema:
    properties = {
        "claim": {
            "enum": [claim.value for claim in Claim],
            "description": "What is known of the map of space being one-to-one. certified: proved on the whole domain; "
            "sampled: holds at the tested points, no proof; refuted: a counterexample was found; undecided: neither "
            "proved nor refuted.",
        },
        "rule": _text("The sufficient condition that was tested."),
        "margin": _number("Distance of the worst place from the limit of the rule: 0 at the limit, 1 at rest."),
        "points_tested": _count("Points tested."),
        "folded_points": _count("Tested points where det of the whole Jacobian is zero or negative."),
        "min_jacobian_determinant": _number("Smallest det of the whole Jacobian (local volume ratio) at the points."),
        "place_mm": _place("The worst place, in rest positions, mm."),
        "boxes_examined": _count("Boxes of space that the proof examined; 0 where none was tried."),
        "boxes_left": _count("Boxes that it could not decide."),
        "gap_mm": _number("No place of the surfaces is farther from a tested point, mm; null where it is not known."),
        "not_covered": _list(
            _text("A file's name."), "Files of attached points that a certified claim does not speak of."
        ),
    }
    return _record(properties, "Is the map one-to-one?")


def _bones() -> Schema:
    residual = {"p99": _number("99th percentile, mm."), "max": _number("Largest, mm.")}
    properties = {
        "contact_zone_mm": _number("Places of a bone that come closer than this to one that moves otherwise, mm."),
        "exposed_vertices": _count("The bones' own vertices outside the contact zone."),
        "exposed_samples": _count("Places of the exposed surface between those where the field is held."),
        "gap_mm": _number("No place of that surface is farther from one of these, mm; null where it is not known."),
        "contact_vertices": _count("Samples inside it, where the field may slip along the bone."),
        "field_residual_mm": _record(residual, "Distance of the field from the rigid motion at the exposed samples."),
        "contact_residual_max_mm": _number(
            "Largest distance from the bone's surface to which a step takes a sample, mm."
        ),
    }
    return _record(properties, "How well the field agrees with the bones, which themselves are moved exactly.")


def _mesh() -> Schema:
    crossing = {
        "a": _text("One tissue."),
        "b": _text("The other, or the same."),
        "crossings": _count("Pairs of triangles."),
    }
    by_tissue = {"name": _text("Name of the tissue."), "inverted": _count("Inverted tetrahedra in it.")}
    properties = {
        "tets": _count("Tetrahedra."),
        "inverted": _count("Tetrahedra with zero or negative volume after the deformation, by an exact predicate."),
        "min_volume_ratio": _number("Smallest deformed volume over rest volume of a tetrahedron."),
        "max_volume_ratio": _number("Largest deformed volume over rest volume of a tetrahedron."),
        "claim": {
            "enum": [claim.value for claim in Claim],
            "description": "What is known of the deformed mesh. certified: every tetrahedron proved positive by an "
            "exact predicate, and the boundary does not cross itself nor lie in tetrahedra; sampled: positive in "
            "floating point; undecided: neither proved nor refuted; refuted: not so.",
        },
        "inverted_by_tissue": _list(_record(by_tissue, "One tissue."), "Where the inverted tetrahedra are."),
        "theorem": _text("What is proved, and from what; empty unless certified."),
        "surfaces": _text("How the original surfaces ride along, of which the claim does not speak."),
        "note": _text("Why it is not certified; empty when it is."),
        "boundary_faces": _count("Triangles of the mesh's boundary."),
        "crossings": _count("Pairs of boundary triangles that cross or touch."),
        "crossing_tissues": _list(_record(crossing, "Two tissues."), "Behind which tissues those pairs are."),
        "worst": _list(_worst_tet(), "The tetrahedra with the smallest volume ratios, inverted ones first."),
        "straight_fraction": _number(
            "How far all vertices may go straight from rest to where they are before a tetrahedron is flat: a proved "
            "fraction, 1 for all the way."
        ),
        "refinement": {
            "description": "How tetrahedra were cut finer; null where nothing had to be cut, or nothing should be.",
            "oneOf": [_refinement(), {"type": "null"}],
        },
    }
    return _record(properties, "The deformed tetrahedra.")


def _worst_tet() -> Schema:
    properties = {
        "tet": _count("Its number in tets.vtu, from 0."),
        "tissue": _text("The tissue it belongs to."),
        "rest_place_mm": _place("Its middle at rest, mm."),
        "place_mm": _place("Its middle after the deformation, mm."),
        "volume_ratio": _number("Deformed volume over rest volume."),
    }
    return _record(properties, "One tetrahedron.")


def _refinement() -> Schema:
    by_tissue = {"name": _text("Name of the tissue."), "cut": _count("Tetrahedra given that were cut.")}
    aside = {
        "name": _text("Name of the tissue."),
        "vertices": _count("Of its tetrahedra; those that tissues share count for each."),
        "farthest_mm": _number("The farthest from where the map, or a held bone's motion, takes it, mm."),
    }
    space = {"tets": _count("Tetrahedra left out."), "volume_mm3": _number("Their volume, mm³.")}
    properties = {
        "rounds": _count("Rounds of splitting edges."),
        "edges_split": _count("Edges split; all tetrahedra around each were cut in two."),
        "tets_before": _count("Tetrahedra before."),
        "inverted_before": _count("Of these, how many came out inverted or flat."),
        "crossings_before": _count("Crossing pairs of boundary triangles, counted where no tetrahedron was inverted."),
        "cut_by_tissue": _list(_record(by_tissue, "One tissue."), "Where tetrahedra were cut."),
        "stopped": _text("Which bound ended the rounds before all was well; empty when all was."),
        "moving_rounds": _count("Rounds of moving vertices aside."),
        "moved_aside": _list(_record(aside, "One tissue."), "Vertices moved off the map by more than 0.01 mm."),
        "left_out": _record(space, "Filler between held bones that had no valid place."),
    }
    return _record(properties, "What was split because tetrahedra came out wrong though the map is one-to-one.")


def _tets() -> Schema:
    space = {"tets": _count("Tetrahedra left out."), "volume_mm3": _number("Their volume, mm³.")}
    properties = {
        "tets": _count("Tetrahedra."),
        "vertices": _count("Their vertices."),
        "left_out": _count("Tetrahedra made that lie in no tissue."),
        "turned": _count("Tetrahedra that came left-handed and had two corners swapped."),
        "joint_space": _record(space, "Filler between bones that slide past each other, left out of the mesh."),
        "tissues": _list(_fit(), "What each tissue got of the mesh; the skin stands for all, the filler for the rest."),
    }
    return _record(properties, "The tetrahedra at rest, held against the surfaces they were made from.")


def _fit() -> Schema:
    no_filler = "null for the filler"
    properties = {
        "name": _text("Name of the tissue."),
        "kind": {"enum": ["skin", "filler", "other", "muscle", "bone"], "description": "What the tissue is."},
        "tets": _count("Tetrahedra that are the tissue's own; for the skin, all inside it."),
        "volume_mm3": _number("Their volume, mm³."),
        "surface_mm3": _number(f"Volume that the given surface encloses, mm³; {no_filler}."),
        "inside_mm3": _number(f"Volume of all tetrahedra inside the given surface, mm³; {no_filler}."),
        "volume_error_percent": _number(f"How much more these fill than the surface encloses, percent; {no_filler}."),
        "yielded_mm3": _number(f"Volume inside the surface that tissues won that come first, mm³; {no_filler}."),
        "envelope_mm": _number(f"How far the tetrahedra's surface may be from the given one, mm; {no_filler}."),
        "off_mm": _number(
            f"Largest distance of the tetrahedra's surface from the given one, sampled, mm; {no_filler}."
        ),
        "missed_mm": _number(f"Largest distance of the given surface from the tetrahedra's, sampled, mm; {no_filler}."),
        "pieces": _count_or_null(f"Pieces into which the tetrahedra inside the surface fall; {no_filler}."),
        "surface_pieces": _count_or_null(f"Pieces into which the surface itself falls; {no_filler}."),
        "alone": _count("Tetrahedra left to the next tissue because no face joined them to others inside the surface."),
    }
    return _record(properties, "One tissue in the mesh at rest.")


def _tissue() -> Schema:
    no_skin = "null where there is no skin, and for the skin itself"
    properties = {
        "name": _text("Name of the tissue."),
        "kind": _kind(),
        "rest_volume_mm3": _number("Volume at rest, mm³."),
        "volume_mm3": _number("Volume after the deformation, mm³."),
        "volume_change_percent": _number("Change of volume, percent of the volume at rest."),
        "rigidity_mm": _number(
            "Bones: largest distance of a vertex from where a rigid motion takes it, mm; else null."
        ),
        "rigidity_reference": {
            "type": ["string", "null"],
            "description": 'Bones: which rigid motion, "prescribed" by the joints or the "best fit"; else null.',
        },
        "outside_skin_rest_mm3": _number(f"Volume outside the skin at rest, mm³; {no_skin}."),
        "outside_skin_mm3": _number(f"Volume outside the skin after the deformation, mm³; {no_skin}."),
        "outside_skin_introduced_mm3": _number(f"Volume newly outside the skin, mm³; {no_skin}."),
    }
    return _record(properties, "One tissue after the deformation.")


def _overlap() -> Schema:
    return _record({"a": _text("One tissue."), "b": _text("The other."), **_overlap_volumes()}, "Two tissues.")


def _overlap_volumes() -> Schema:
    return {
        "rest_mm3": _number("Volume of the intersection at rest, mm³."),
        "deformed_mm3": _number("Volume of the intersection after the deformation, mm³."),
        "introduced_mm3": _number(
            "Deformed overlap beyond the rest overlap carried along by the map, mm³; never below 0."
        ),
    }


def _checks() -> Schema:
    properties = {
        "name": _text("What is held against the limit."),
        "value": _number("The value found; null where it is missing or not finite, which fails."),
        "limit": _number("The largest value that passes; null where there is no limit."),
        "unit": _text("Unit of value and limit; empty for yes (1) or no (0)."),
        "place": _text("Where the value was found; empty where there is no such place."),
        "passed": {"type": "boolean", "description": "Whether the value is a number at or below the limit."},
        "next_step": _text("What to do where it fails: a key to set or a command to run."),
    }
    return _list(_record(properties, "One limit held against one number."), "All checks; every one must pass.")


def _not_checked() -> Schema:
    properties = {"what": _text("A tissue or a pair."), "reason": _text("Why it could not be checked.")}
    return _list(
        _record(properties, "One thing not checked."), "What could not be checked; anything here fails the run."
    )


def _finding() -> Schema:
    properties = {
        "subject": _text("The tissue or file."),
        "code": _text("A short stable word."),
        "message": _text("What was found, with numbers."),
    }
    return _record(properties, "Something found in the input.")


def _files() -> Schema:
    return _list(_text("Path relative to the report, with forward slashes."), "Every file that was written.")


def _surface() -> Schema:
    properties = {
        "name": _text("Name of the tissue."),
        "ply": _text("Its deformed surface as PLY."),
        "vtp": _text("Its deformed surface as VTP, with displacements."),
    }
    return _record(properties, "The files of one tissue.")


def _document(title: str, properties: Schema, required: list[str]) -> Schema:
    return {
        "$schema": _DIALECT,
        "title": title,
        "description": "Lengths in mm, volumes in mm³. A number that is missing or not finite is null.",
        "type": "object",
        "properties": properties,
        "required": required,
        "additionalProperties": False,
    }


def _record(properties: Schema, description: str) -> Schema:
    return {
        "type": "object",
        "description": description,
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _list(items: Schema, description: str) -> Schema:
    return {"type": "array", "description": description, "items": items}


def _place(description: str) -> Schema:
    return {
        "type": "array",
        "items": {"type": ["number", "null"]},
        "minItems": 3,
        "maxItems": 3,
        "description": description,
    }


def _text(description: str) -> Schema:
    return {"type": "string", "description": description}


def _number(description: str) -> Schema:
    return {"type": ["number", "null"], "description": description}


def _count(description: str) -> Schema:
    return {"type": "integer", "minimum": 0, "description": description}


def _count_or_null(description: str) -> Schema:
    return {"type": ["integer", "null"], "minimum": 0, "description": description}


def _kind() -> Schema:
    return {"enum": ["skin", "other", "muscle", "bone"], "description": "What the tissue is."}


def _verdict() -> Schema:
    return {"enum": ["passed", "failed"], "description": "passed when every check passed."}
