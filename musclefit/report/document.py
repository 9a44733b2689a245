"""The reports as JSON values: keys, meanings and units, once. Values and JSON Schema are both made from these records.

A record that was measured becomes a part of the document by its attributes' names; where the document has a key that no
attribute has, `Part.of` is told its value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator
from pydantic.json_schema import GenerateJsonSchema

from musclefit.vocabulary import Claim, Purpose

Schema = dict[str, Any]

_DIALECT = "https://json-schema.org/draft/2020-12/schema"


def _finite(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)


def _whole(value: Any) -> int | None:
    return None if value is None else int(value)


def plain(value: object, key: str = "provenance") -> Any:
    """A value in JSON's own types.

    Raises
    ------
    TypeError
        It holds something that has no JSON form; names its key.
    """
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return _finite(value)
    if isinstance(value, Mapping):
        return {str(k): plain(v, f"{key}.{k}") for k, v in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray):
        return [plain(v, f"{key}[{i}]") for i, v in enumerate(value)]
    raise TypeError(
        f"{key} is a {type(value).__name__}; give text, numbers, booleans, None, lists or mappings of these"
    )


Number = Annotated[float | None, BeforeValidator(_finite)]
"""Null where it is missing or not finite."""

Count = Annotated[int, BeforeValidator(_whole), Field(ge=0)]
CountOrNone = Annotated[Annotated[int, Field(ge=0)] | None, BeforeValidator(_whole)]
Place = tuple[Number, Number, Number]
Kind = Annotated[Literal["skin", "other", "muscle", "bone"], BeforeValidator(str)]
Verdict = Literal["passed", "failed"]


def _says(text: str, **more: Any) -> Any:
    return Field(description=text, **more)


class Part(BaseModel):
    """A part of a document: every key is written, and no other."""

    model_config = ConfigDict(from_attributes=True, extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _of_row(cls, value: Any) -> Any:
        """A tuple has the values in the order of the keys."""
        return dict(zip(cls.model_fields, value, strict=True)) if isinstance(value, tuple) else value

    @classmethod
    def of(cls, found: object, **more: object) -> Self:
        """Of a record with attributes of the same names, and of what it does not have."""
        own = {name: getattr(found, name) for name in cls.model_fields if name not in more and hasattr(found, name)}
        return cls.model_validate(own | more)

    def values(self) -> dict[str, Any]:
        """JSON values; keys that were left out stay out."""
        return self.model_dump(mode="json", exclude_unset=True)


class Landmarks(Part):
    """How far the landmarks are from their destinations."""

    count: Count = _says("Landmarks driving the deformation.")
    max_error_mm: Number = _says("Largest distance of a landmark from its destination, mm.")
    worst: str = _says("Name of the landmark with that distance.")


class Map(Part):
    """Whether the map is one-to-one."""

    claim: Claim = _says(
        "What is known of the map of space being one-to-one. certified: proved on the whole domain; sampled: holds at "
        "the tested points, no proof; refuted: a counterexample was found; undecided: neither proved nor refuted."
    )
    rule: str = _says("The sufficient condition that was tested.")
    margin: Number = _says("Distance of the worst place from the limit of the rule: 0 at the limit, 1 at rest.")
    points_tested: Count = _says("Points tested.")
    folded_points: Count = _says("Tested points where det of the whole Jacobian is zero or negative.")
    min_jacobian_determinant: Number = _says("Smallest det of the whole Jacobian (local volume ratio) at the points.")
    place_mm: Place = _says("The worst place, in rest positions, mm.")
    boxes_examined: Count = _says("Boxes of space that the proof examined; 0 where none was tried.")
    boxes_left: Count = _says("Boxes that it could not decide.")
    gap_mm: Number = _says("No point of the surfaces is farther from a tested point, mm; null where unknown.")
    not_covered: list[str] = _says("Files of attached points that a certified claim does not cover.")


class FieldResidual(Part):
    """Of the exposed surface."""

    p99: Number = _says("99th percentile, mm.")
    max: Number = _says("Largest, mm.")


class Bones(Part):
    """How well the field agrees with the bones, which themselves are moved exactly."""

    contact_zone_mm: Number = _says("Distance between bones that move differently below which the field may slip, mm.")
    exposed_vertices: Count = _says("The bones' own vertices outside the contact zone.")
    exposed_samples: Count = _says("Places of the exposed surface between those where the field is held.")
    gap_mm: Number = _says("No point of that surface is farther from one of these, mm; null where unknown.")
    contact_vertices: Count = _says("Samples inside it, where the field may slip along the bone.")
    field_residual_mm: FieldResidual = _says("Distance of the field from the rigid motion at the exposed samples.")
    contact_residual_max_mm: Number = _says(
        "Largest distance from the bone's surface to which a step takes a sample, mm."
    )


class InvertedIn(Part):
    """One tissue."""

    name: str = _says("Name of the tissue.")
    inverted: Count = _says("Inverted tetrahedra in it.")


class CrossingTissues(Part):
    """Two tissues."""

    a: str = _says("One tissue.")
    b: str = _says("The other, or the same.")
    crossings: Count = _says("Pairs of triangles.")


class Tetrahedron(Part):
    """One tetrahedron."""

    tet: Count = _says("Its number in tets.vtu, from 0.")
    tissue: str = _says("The tissue it belongs to.")
    rest_place_mm: Place = _says("Its middle at rest, mm.")
    place_mm: Place = _says("Its middle after the deformation, mm.")
    volume_ratio: Number = _says("Deformed volume over rest volume.")


class CutIn(Part):
    """One tissue."""

    name: str = _says("Name of the tissue.")
    cut: Count = _says("Tetrahedra given that were cut.")


class MovedAside(Part):
    """One tissue."""

    name: str = _says("Name of the tissue.")
    vertices: Count = _says("Of its tetrahedra; those that tissues share count for each.")
    farthest_mm: Number = _says("Largest distance from where the map, or a held bone's motion, takes it, mm.")


class LeftOut(Part):
    """Filler between bones."""

    tets: Count = _says("Tetrahedra left out.")
    volume_mm3: Number = _says("Their volume, mm³.")


class Refinement(Part):
    """What was split because tetrahedra came out wrong though the map is one-to-one."""

    rounds: Count = _says("Rounds of splitting edges.")
    edges_split: Count = _says("Edges split; all tetrahedra around each were cut in two.")
    tets_before: Count = _says("Tetrahedra before.")
    inverted_before: Count = _says("Of these, how many were inverted or flat.")
    crossings_before: Count = _says("Crossing pairs of boundary triangles, counted where no tetrahedron was inverted.")
    cut_by_tissue: list[CutIn] = _says("Where tetrahedra were cut.")
    stopped: str = _says("Which bound ended the rounds before all was well; empty when all was.")
    moving_rounds: Count = _says("Rounds of moving vertices aside.")
    moved_aside: list[MovedAside] = _says("Vertices moved off the map by more than 0.01 mm.")
    left_out: LeftOut = _says("Filler between held bones for which no valid position was found.")


class Mesh(Part):
    """The deformed tetrahedra."""

    tets: Count = _says("Tetrahedra.")
    inverted: Count = _says("Tetrahedra with zero or negative volume after the deformation, by an exact predicate.")
    min_volume_ratio: Number = _says("Smallest deformed volume over rest volume of a tetrahedron.")
    max_volume_ratio: Number = _says("Largest deformed volume over rest volume of a tetrahedron.")
    claim: Claim = _says(
        "What is known of the deformed mesh. certified: every tetrahedron proved positive by an exact predicate, and "
        "the boundary does not cross itself nor lie in tetrahedra; sampled: positive in floating point; undecided: "
        "neither proved nor refuted; refuted: not so."
    )
    inverted_by_tissue: list[InvertedIn] = _says("Where the inverted tetrahedra are.")
    theorem: str = _says("What is proved, and from what; empty unless certified.")
    surfaces: str = _says("How the original surfaces are moved; the claim does not cover them.")
    note: str = _says("Why it is not certified; empty when it is.")
    boundary_faces: Count = _says("Triangles of the mesh's boundary.")
    crossings: Count = _says("Pairs of boundary triangles that cross or touch.")
    crossing_tissues: list[CrossingTissues] = _says("Behind which tissues those pairs are.")
    worst: list[Tetrahedron] = _says("The tetrahedra with the smallest volume ratios, inverted ones first.")
    straight_fraction: Number = _says(
        "How far all vertices can move in straight lines from rest to their positions before a tetrahedron is flat: a "
        "proved fraction, 1 for the whole way."
    )
    refinement: Refinement | None = _says(
        "How tetrahedra were cut finer; null where nothing had to be cut, or nothing should be."
    )


_NO_FILLER = "null for the filler"


class TissueFit(Part):
    """One tissue in the mesh at rest."""

    name: str = _says("Name of the tissue.")
    kind: Annotated[Literal["skin", "filler", "other", "muscle", "bone"], BeforeValidator(str)] = _says(
        "What the tissue is."
    )
    tets: Count = _says("Tetrahedra that are the tissue's own; for the skin, all inside it.")
    volume_mm3: Number = _says("Their volume, mm³.")
    surface_mm3: Number = _says(f"Volume that the given surface encloses, mm³; {_NO_FILLER}.")
    inside_mm3: Number = _says(f"Volume of all tetrahedra inside the given surface, mm³; {_NO_FILLER}.")
    volume_error_percent: Number = _says(f"How much more these fill than the surface encloses, percent; {_NO_FILLER}.")
    yielded_mm3: Number = _says(f"Volume inside the surface given to tissues of higher priority, mm³; {_NO_FILLER}.")
    envelope_mm: Number = _says(f"How far the tetrahedra's surface may be from the given one, mm; {_NO_FILLER}.")
    off_mm: Number = _says(
        f"Largest distance of the tetrahedra's surface from the given one, sampled, mm; {_NO_FILLER}."
    )
    missed_mm: Number = _says(
        f"Largest distance of the given surface from the tetrahedra's, sampled, mm; {_NO_FILLER}."
    )
    pieces: CountOrNone = _says(f"Pieces into which the tetrahedra inside the surface fall; {_NO_FILLER}.")
    surface_pieces: CountOrNone = _says(f"Pieces into which the surface itself falls; {_NO_FILLER}.")
    alone: Count = _says("Tetrahedra left to the next tissue because no face joined them to others inside the surface.")


class Tets(Part):
    """The tetrahedra at rest, held against the surfaces they were made from."""

    tets: Count = _says("Tetrahedra.")
    vertices: Count = _says("Their vertices.")
    left_out: Count = _says("Tetrahedra discarded because they lie in no tissue.")
    turned: Count = _says("Left-handed tetrahedra in which two corners were swapped.")
    joint_space: LeftOut = _says("Filler between bones that slide past each other, left out of the mesh.")
    tissues: list[TissueFit] = _says(
        "The part of the mesh that each tissue has; the skin stands for all of it, the filler for the rest."
    )


_NO_SKIN = "null where there is no skin, and for the skin itself"


class Tissue(Part):
    """One tissue after the deformation."""

    name: str = _says("Name of the tissue.")
    kind: Kind = _says("What the tissue is.")
    rest_volume_mm3: Number = _says("Volume at rest, mm³.")
    volume_mm3: Number = _says("Volume after the deformation, mm³.")
    volume_change_percent: Number = _says("Change of volume, percent of the volume at rest.")
    rigidity_mm: Number = _says(
        "Bones: largest distance of a vertex from where a rigid motion takes it, mm; else null."
    )
    rigidity_reference: str | None = _says(
        'Bones: which rigid motion, "prescribed" by the joints or the "best fit"; else null.'
    )
    outside_skin_rest_mm3: Number = _says(f"Volume outside the skin at rest, mm³; {_NO_SKIN}.")
    outside_skin_mm3: Number = _says(f"Volume outside the skin after the deformation, mm³; {_NO_SKIN}.")
    outside_skin_introduced_mm3: Number = _says(f"Volume newly outside the skin, mm³; {_NO_SKIN}.")


class OverlapVolumes(Part):
    """Overlap volumes."""

    rest_mm3: Number = _says("Volume of the intersection at rest, mm³.")
    deformed_mm3: Number = _says("Volume of the intersection after the deformation, mm³.")
    introduced_mm3: Number = _says(
        "Deformed overlap beyond the image of the rest overlap under the map, mm³; never below 0."
    )


class Overlap(OverlapVolumes):
    """Two tissues."""

    a: str = _says("One tissue.")
    b: str = _says("The other.")


class BoneOverlap(Part):
    """Two bones."""

    a: str = _says("One bone.")
    b: str = _says("The other.")
    rest_mm3: Number = _says("Volume of their intersection at rest, mm³.")
    posed_mm3: Number = _says("Volume of their intersection where their motions put them, mm³.")
    beyond_mm3: Number = _says("The part of it beyond the mapped intersection at rest, mm³.")
    beyond_limit_mm3: Number = _says(
        "How much of that does not count as a collision, by the size of the smaller bone, mm³."
    )
    depth_mm: Number = _says("Largest depth below the surface of either bone, mm.")
    depth_limit_mm: Number = _says("How deep does not count as a collision, by the size of the smaller bone, mm.")


class NotChecked(Part):
    """One thing not checked."""

    what: str = _says("A tissue or a pair.")
    reason: str = _says("Why it could not be checked.")


class Finding(Part):
    """Something found in the input."""

    subject: str = _says("The tissue or file.")
    code: str = _says("A short stable word.")
    message: str = _says("What was found, with numbers.")
    next_step: str = _says("What to do about it; empty where the message says so or nothing need be done.", default="")


class Check(Part):
    """One value checked against its limit."""

    name: str = _says("What is checked.")
    value: Number = _says("The value found; null where it is missing or not finite, which fails.")
    limit: Number = _says("The largest value that passes; null where there is no limit.")
    unit: str = _says("Unit of value and limit; empty for yes (1) or no (0).")
    place: str = _says("Where the value was found; empty where there is no such place.")
    passed: bool = _says("Whether the value is a number at or below the limit.")
    next_step: str = _says("What to do where it fails: a key to set or a command to run.")


class Outcome(Part):
    """One method's outcome."""

    verdict: Verdict = _says("passed when every check passed.")
    status: str = _says('"converged", or how the run ended instead, in words.')
    steps: Count = _says("Steps taken.")
    method: str = _says("The method in words.")
    landmarks: Landmarks = _says("How far the landmarks are from their destinations.")
    map: Map = _says("Whether the map is one-to-one.")
    mesh: Mesh | None = _says("The deformed tetrahedra; null where none were made.")
    steps_rejected: Count = _says("Substeps of the path that were tried and shortened.")
    edges_split: Count = _says("Edges of the surfaces that were split because the map bends them.")
    edges_left_bent: Count = _says("Edges still bent beyond the tolerance.")
    crossings_left: Count = _says(
        "Pairs of triangles that cross after the deformation and that subdivision does not separate."
    )
    steps_returned: Count = _says("How often a step was shortened because points between the tested ones failed.")
    bones: Bones | None = _says("The field at the bones; null where bones are not held rigid.")
    tissues: list[Tissue] = _says("All tissues, outermost first.")
    overlaps: list[Overlap] = _says("Overlapping pairs, largest first.")
    overlap_total: OverlapVolumes = _says("Overlap volumes summed over all pairs.")
    bone_overlaps: list[BoneOverlap] = _says(
        "Overlap of held bones due to their rigid motions alone, known before the deformation: below the limits of a "
        "collision, and not counted as introduced."
    )
    pairs_tested: Count = _says("Pairs of tissues tested for overlap.")
    not_checked: list[NotChecked] = _says("What could not be checked; anything here fails the run.")
    checks: list[Check] = _says("All checks; every one must pass.")


class RangeEnd(Part):
    """Where a range ends."""

    degrees: Number = _says("How far it can turn to this side, degrees; up to the resolution short of the true end.")
    ended_by: Literal["bones", "limit", "not met"] = _says(
        "Colliding bones, the stated limit, or nothing up to 180 degrees."
    )
    beyond: BoneOverlap | None = _says("The colliding bones, one step beyond the end; null if there are none.")


class JointRange(Part):
    """One coordinate's free range, all others at rest."""

    joint: str = _says("Name of the coordinate, as a pose names it.")
    low: RangeEnd = _says("Where its range ends below rest.")
    high: RangeEnd = _says("Where its range ends above rest.")
    limits_deg: tuple[Number, Number] = _says("The limits stated for it, degrees; null where there is none.")
    step_deg: Number = _says("Largest angle between tests for collisions, degrees.")
    resolution_deg: Number = _says("Resolution of the ends, degrees.")
    untested: list[str] = _says("Bones that were left out because they are not solids.")


class Limits(Part):
    """The limits that the result is checked against."""

    purpose: Purpose = _says(
        "What the limits are for: another pose of the same body, or another body, whose bones and muscles are reported "
        "without limits unless the rig sets them."
    )
    because: str = _says("Why they are for this purpose.")
    landmark_mm: Number = _says("Landmark error, mm.")
    bone_rigidity_mm: Number = _says(
        "Bone off rigid, mm; null for no limit; bones that are held or kept always have one."
    )
    muscle_volume_percent: Number = _says("Muscle volume change, percent; null for no limit.")
    introduced_overlap_mm3: Number = _says("Introduced overlap, mm³.")
    grown_overlap_mm3: Number = _says("Grown overlap, mm³.")
    introduced_outside_skin_mm3: Number = _says("Introduced volume outside the skin, mm³.")
    inverted_tets: Count = _says("Inverted tetrahedra.")


class CertificateCost(Part):
    """Cost of the certificate."""

    certificate_s: Number = _says("Seconds of the proof of the result's map.")
    deformation_s: Number = _says("Seconds of the deformation itself.")
    share: Number = _says("The first over the second.")


class SurfaceFiles(Part):
    """The files of one tissue."""

    name: str = _says("Name of the tissue.")
    ply: str = _says("Its deformed surface as PLY.")
    vtp: str = _says("Its deformed surface as VTP, with displacements.")


class _Document(Part):
    schema_version: Literal[1] = _says("Version of these keys and their meaning.")
    timings_s: dict[str, Number] = _says("Wall time by stage, seconds.")
    peak_memory_mb: Number = _says("Largest resident memory of the process, MB (10⁶ bytes); null where unknown.")
    provenance: Annotated[dict[str, Any], BeforeValidator(plain)] = _says(
        "Versions, hashes of the input files, and settings."
    )
    files: list[str] = _says(
        "Every file that was written: paths relative to the report, with forward slashes.", default=[]
    )


class RunDocument(Outcome, _Document):
    """Lengths in mm, volumes in mm³. A number that is missing or not finite is null."""

    title: str = _says("Title of the rig.")
    limits: Limits = _says("The limits that the result is checked against.")
    tets: Tets | None = _says("The tetrahedra at rest; null where none were made.")
    joint_ranges: list[JointRange] = _says("How far the joints that the pose turns can turn; no part of the verdict.")
    findings: list[Finding] = _says("What was found in the input; no part of the verdict.")
    baseline: Outcome | None = _says(
        "The same keys for the same handles in one shot, held against the same limits; null where that was not run. "
        "It never changes the verdict."
    )
    paper_loop: Outcome | None = _says(
        "The same keys for the same handles by the loop of Yu et al. 2014, held against the same limits; null where "
        "the result is that loop's own, or it was not run. It never changes the verdict."
    )
    certificate_cost: CertificateCost | None = _says(
        "What the proof that the map is one-to-one took beside the deformation, wall time; null where none was tried."
    )
    surfaces: list[SurfaceFiles] = _says("Which files hold which tissue.", default=[])


class TissueAsItIs(Part):
    """One tissue."""

    name: str = _says("Name of the tissue.")
    kind: Kind = _says("What the tissue is.")
    vertices: Count = _says("Vertices of its surface.")
    triangles: Count = _says("Triangles of its surface.")
    volume_mm3: Number = _says("Signed enclosed volume, mm³.")
    outside_skin_mm3: Number = _says("Volume outside the skin, mm³; null where there is no skin, and for the skin.")


class SharedVolume(Part):
    """Two tissues that overlap."""

    a: str = _says("One tissue.")
    b: str = _says("The other tissue.")
    volume_mm3: Number = _says("Volume of their intersection, mm³.")


class InspectionDocument(_Document):
    """Lengths in mm, volumes in mm³. A number that is missing or not finite is null."""

    title: str = _says("What was inspected.")
    verdict: Verdict = _says("passed when every check passed.")
    frame: str = _says("The coordinate frame in words.")
    tissues: list[TissueAsItIs] = _says("All tissues, outermost first.")
    overlaps: list[SharedVolume] = _says("Overlapping pairs, largest first.")
    overlap_total_mm3: Number = _says("Overlap volume summed over all pairs, mm³.")
    pairs_tested: Count = _says("Pairs of tissues tested for overlap.")
    not_checked: list[NotChecked] = _says("What could not be checked; anything here fails the run.")
    findings: list[Finding] = _says("What was found in the input.")
    checks: list[Check] = _says("All checks; every one must pass.")


class _WithoutTitles(GenerateJsonSchema):
    """Keys say what they are by themselves."""

    def field_title_should_be_set(self, schema: Any) -> bool:  # noqa: ARG002 (as in the base class)
        return False


def schema_of(part: type[Part], title: str) -> Schema:
    """JSON Schema (draft 2020-12) of a part, or of a whole document."""
    found = part.model_json_schema(mode="validation", schema_generator=_WithoutTitles)
    return {"$schema": _DIALECT, **found, "title": title}
