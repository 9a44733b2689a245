"""Which tissues overlap, and which leave the skin: at rest, deformed, and introduced by the deformation.

A one-to-one map cannot make disjoint tissues intersect, but meshes see it only at their vertices; and what overlaps at
rest rides along. So *introduced* is the deformed volume for what was apart at rest, and the deformed volume beyond the
volume of the mapped rest overlap for the others, never below 0.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.errors import InputError, MeshError
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.queries.solids import (
    ROUNDING_MM3,
    Solid,
    candidate_pairs,
    outside_part,
    overlap_part,
    overlap_volume,
    solid_of,
    volume_outside,
)
from musclefit.geometry.surfaces.crossings import TOUCHING_MM, self_crossings
from musclefit.progress import Progress
from musclefit.validate.carried_volumes import Mapped, carried_volumes
from musclefit.validate.model import BoneOverlap, NotChecked, OutsideCheck, OutsideSkin, OverlapCheck, PairOverlap

WHOLE_RELATIVE = 1e-9
"""A part is the whole of a tissue when its volume falls short by at most this fraction."""

Pair = tuple[str, str]


@dataclass(frozen=True, eq=False, slots=True)
class _Part:
    """What two solids share, or what of one is outside the other: volume in mm³ and, where there is any, surface."""

    volume: float
    surface: TriMesh | None


@dataclass(frozen=True, eq=False, slots=True)
class SolidAnatomy:
    """An anatomy whose surfaces are prepared for booleans; made by `solid_anatomy`, once for many checks.

    Parameters
    ----------
    anatomy : Anatomy
    solids : mapping of tissue name to Solid
    refused : mapping of tissue name to the reason why its surface is not a solid
    known : dict
        What was measured of pairs already, so that a rest that is checked against many poses is measured once.
    """

    anatomy: Anatomy
    solids: Mapping[str, Solid]
    refused: Mapping[str, str]
    known: dict[tuple[str, Pair], _Part] = field(default_factory=dict)

    def only(self, names: Collection[str]) -> SolidAnatomy:
        """With the solids of the tissues named alone: those of a whole limb take some 100 MB."""
        return replace(self, solids={name: solid for name, solid in self.solids.items() if name in names}, known={})


def solid_anatomy(anatomy: Anatomy, *, progress: Progress) -> SolidAnatomy:
    """Prepare every surface for booleans; a surface that is not a solid is kept with the reason."""
    solids: dict[str, Solid] = {}
    refused: dict[str, str] = {}
    with progress.stage("solids") as tick:
        for number, tissue in enumerate(anatomy):
            try:
                solids[tissue.name] = solid_of(tissue.surface)
            except MeshError as error:
                refused[tissue.name] = str(error)
            tick((number + 1) / len(anatomy))
    return SolidAnatomy(anatomy, solids, refused)


def rest_overlaps(anatomy: Anatomy | SolidAnatomy, *, progress: Progress) -> OverlapCheck:
    """Every overlapping pair of tissues, the skin left out, as the anatomy stands.

    Returns
    -------
    OverlapCheck
        With ``deformed_mm3`` equal to ``rest_mm3`` and nothing introduced.
    """
    rest = _solid(anatomy, progress)
    names = _names_without_skin(rest.anatomy)
    near = _near_pairs(rest, names)
    volumes, failed = _volumes(rest, near, measure=_OVERLAP, when="at rest", progress=progress)
    pairs = [PairOverlap(a, b, volume, volume, 0.0) for (a, b), volume in volumes.items() if volume > ROUNDING_MM3]
    solid = sum(name in rest.solids for name in names)
    return OverlapCheck(
        pairs=_largest_first(pairs),
        pairs_tested=solid * (solid - 1) // 2 - len(failed),
        not_checked=(*_refusals(names, (rest, "at rest")), *failed),
    )


def check_overlaps(
    rest: Anatomy | SolidAnatomy,
    deformed: Anatomy | SolidAnatomy,
    *,
    mapped: Mapped,
    by_motions: Sequence[BoneOverlap] = (),
    progress: Progress,
) -> OverlapCheck:
    """Every pair of tissues, the skin left out, that overlaps at rest or deformed.

    Parameters
    ----------
    rest, deformed : Anatomy or SolidAnatomy
        The same tissues before and after. Give `solid_anatomy` of the rest when it is checked against many poses.
    mapped : callable
        The map of space that made ``deformed`` from ``rest``, (N, 3) mm -> (N, 3) mm and its (N, 3, 3) Jacobians;
        carries the rest overlap along.
    by_motions : sequence of BoneOverlap
        What bones that are moved rigidly share by their motions alone; only what is beyond it counts as introduced.

    Returns
    -------
    OverlapCheck
        ``pairs_tested`` counts all pairs of which both volumes are known, those with boxes apart included.
        A tissue that is wholly inside another at rest introduces nothing: it cannot overlap it more.
        ``not_checked`` also names each tissue that crosses itself deformed and did not at rest: its pairs are listed,
        but where it is inside out its overlaps count negative and may cancel. (Tissues that cross themselves at rest
        are the reader's findings.) What reaches no farther through itself than `TOUCHING_MM` is in ``touching``.

    Raises
    ------
    InputError
        The two anatomies have different tissues.
    """
    before, after = _solid(rest, progress), _solid(deformed, progress)
    _require_same_tissues(before.anatomy, after.anatomy)
    names = _names_without_skin(before.anatomy)
    solid = [name for name in names if name in before.solids and name in after.solids]
    near = sorted({*_near_pairs(before, solid), *_near_pairs(after, solid)})
    known, failed = _introduced(before, after, near, measure=_OVERLAP, mapped=mapped, progress=progress)
    given = {frozenset((overlap.a, overlap.b)): overlap.posed_mm3 for overlap in by_motions}
    pairs = [
        PairOverlap(a, b, v.rest, v.deformed, _beyond_given(v, given.get(frozenset((a, b)))))
        for (a, b), v in known.items()
        if max(v.rest, v.deformed) > ROUNDING_MM3
    ]
    crossing, touching = _newly_crossing(before, after, solid, progress=progress)
    return OverlapCheck(
        pairs=_largest_first(pairs),
        pairs_tested=len(solid) * (len(solid) - 1) // 2 - len(near) + len(known),
        not_checked=(
            *_refusals(names, (before, "at rest"), (after, "deformed")),
            *crossing,
            *failed,
        ),
        bones=tuple(by_motions),
        touching=touching,
    )


def check_outside_skin(
    rest: Anatomy | SolidAnatomy, deformed: Anatomy | SolidAnatomy, *, mapped: Mapped, progress: Progress
) -> OutsideCheck:
    """Volume of every tissue outside the skin: at rest, deformed and introduced.

    Parameters
    ----------
    rest, deformed : Anatomy or SolidAnatomy
        The same tissues before and after.
    mapped : callable
        As for `check_overlaps`; carries along what was outside at rest.

    Returns
    -------
    OutsideCheck
        Empty where there is no skin; without tissues, and with the reason, where the skin is not a solid.
        A tissue that is wholly outside at rest introduces nothing.

    Raises
    ------
    InputError
        The two anatomies have different tissues.
    """
    before, after = _solid(rest, progress), _solid(deformed, progress)
    _require_same_tissues(before.anatomy, after.anatomy)
    skin = before.anatomy.skin
    if skin is None:
        return OutsideCheck((), ())
    names = _names_without_skin(before.anatomy)
    refused = _refusals((skin.name, *names), (before, "at rest"), (after, "deformed"))
    if skin.name not in before.solids or skin.name not in after.solids:
        return OutsideCheck((), refused)
    pairs = [(name, skin.name) for name in names if name in before.solids and name in after.solids]
    known, failed = _introduced(before, after, pairs, measure=_OUTSIDE, mapped=mapped, progress=progress)
    tissues = tuple(OutsideSkin(name, v.rest, v.deformed, v.introduced) for (name, _), v in known.items())
    return OutsideCheck(tissues, (*refused, *failed))


@dataclass(frozen=True, slots=True)
class _Measure:
    """What is measured of two solids: its volume, its surface, and how large it can be at most."""

    title: str
    volume: Callable[[Solid, Solid], float]
    part: Callable[[Solid, Solid], tuple[float, TriMesh]]
    most: Callable[[Solid, Solid], float]


_OVERLAP = _Measure("overlaps", overlap_volume, overlap_part, lambda a, b: min(a.volume, b.volume))
_OUTSIDE = _Measure("outside the skin", volume_outside, outside_part, lambda a, _: a.volume)


@dataclass(frozen=True, slots=True)
class _Volumes:
    """Volumes of one pair, mm³."""

    rest: float
    deformed: float
    introduced: float


def _introduced(
    before: SolidAnatomy,
    after: SolidAnatomy,
    pairs: Sequence[Pair],
    *,
    measure: _Measure,
    mapped: Mapped,
    progress: Progress,
) -> tuple[dict[Pair, _Volumes], tuple[NotChecked, ...]]:
    """Volumes of each pair at rest, deformed and introduced, and the pairs of which they are not known."""
    parts, failed_rest = _parts_at_rest(before, pairs, measure=measure, progress=progress)
    at_rest = {pair: part.volume for pair, part in parts.items()}
    at_end, failed_end = _volumes(after, list(at_rest), measure=measure, when="deformed", progress=progress)
    riding, whole = [], set()
    for a, b in at_end:
        most = measure.most(before.solids[a], before.solids[b])
        if at_rest[a, b] >= most * (1.0 - WHOLE_RELATIVE):
            whole.add((a, b))
        elif min(at_rest[a, b], at_end[a, b]) > ROUNDING_MM3:
            riding.append((a, b))
    surfaces = [surface for pair in riding if (surface := parts[pair].surface) is not None]
    with progress.stage(f"{measure.title}: mapping those at rest") as tick:
        against = [at_end[pair] for pair in riding]
        found = carried_volumes(surfaces, against=against, mapped=mapped, tick=tick)
        carried = dict(zip(riding, found, strict=True))
    known = {}
    for pair, deformed in at_end.items():
        ridden = carried[pair].volume_mm3 if pair in carried else 0.0
        beyond = 0.0 if pair in whole or deformed <= ROUNDING_MM3 else max(deformed - ridden, 0.0)
        known[pair] = _Volumes(at_rest[pair], deformed, beyond)
    unsettled = tuple(
        NotChecked(f"{a} / {b}", f"{measure.title}: mapped volume of what was there at rest: {c.doubt()}")
        for (a, b), c in carried.items()
        if not c.settled
    )
    return known, (*failed_rest, *failed_end, *unsettled)


def _beyond_given(found: _Volumes, given: float | None) -> float:
    """What is introduced beyond a volume that was given with the motions, which is measured alike but for rounding."""
    if given is None:
        return found.introduced
    beyond = found.deformed - given
    rounding = max(ROUNDING_MM3, WHOLE_RELATIVE * given)
    return 0.0 if beyond <= rounding else min(found.introduced, beyond)


def _parts_at_rest(
    state: SolidAnatomy, pairs: Sequence[Pair], *, measure: _Measure, progress: Progress
) -> tuple[dict[Pair, _Part], tuple[NotChecked, ...]]:
    """The measured part of each pair at rest, measured once, and the pairs whose volume cannot be believed."""
    parts, failed = {}, []
    with progress.stage(f"{measure.title} at rest") as tick:
        for number, pair in enumerate(pairs):
            key = measure.title, pair
            if key not in state.known:
                try:
                    volume, surface = measure.part(*(state.solids[name] for name in pair))
                except MeshError as error:
                    failed.append(NotChecked(" / ".join(pair), f"{measure.title} at rest: {error}"))
                    continue
                state.known[key] = _Part(volume, surface if volume > ROUNDING_MM3 else None)
            parts[pair] = state.known[key]
            tick((number + 1) / len(pairs))
    return parts, tuple(failed)


def _volumes(
    state: SolidAnatomy, pairs: Sequence[Pair], *, measure: _Measure, when: str, progress: Progress
) -> tuple[dict[Pair, float], tuple[NotChecked, ...]]:
    """The measured volume of each pair, and the pairs whose volume cannot be believed.

    Plain loop on purpose: the booleans use all cores themselves.
    """
    volumes, failed = {}, []
    with progress.stage(f"{measure.title} {when}") as tick:
        for number, (a, b) in enumerate(pairs):
            try:
                volumes[a, b] = measure.volume(state.solids[a], state.solids[b])
            except MeshError as error:
                failed.append(NotChecked(f"{a} / {b}", f"{measure.title} {when}: {error}"))
            tick((number + 1) / len(pairs))
    return volumes, tuple(failed)


def _newly_crossing(
    before: SolidAnatomy, after: SolidAnatomy, names: Sequence[str], *, progress: Progress
) -> tuple[tuple[NotChecked, ...], tuple[tuple[str, int], ...]]:
    """Tissues whose surface crosses itself deformed, but not at rest; and those that touch themselves."""
    found, touching = [], []
    with progress.stage("tissues that cross themselves") as tick:
        for number, name in enumerate(names):
            surface = after.anatomy[name].surface
            crossings = self_crossings(surface)
            if len(crossings) and not len(self_crossings(before.anatomy[name].surface)):
                count = len(crossings.deeper(surface, than_mm=TOUCHING_MM))
                if count:
                    found.append(
                        NotChecked(
                            name,
                            f"deformed: crosses itself at {count} pairs of triangles, and did not at rest; where it is "
                            "inside out its overlaps count negative and may cancel",
                        )
                    )
                if len(crossings) > count:
                    touching.append((name, len(crossings) - count))
            tick((number + 1) / len(names))
    return tuple(found), tuple(touching)


def _solid(anatomy: Anatomy | SolidAnatomy, progress: Progress) -> SolidAnatomy:
    return anatomy if isinstance(anatomy, SolidAnatomy) else solid_anatomy(anatomy, progress=progress)


def _names_without_skin(anatomy: Anatomy) -> tuple[str, ...]:
    return tuple(tissue.name for tissue in anatomy if tissue.kind is not TissueKind.SKIN)


def _require_same_tissues(rest: Anatomy, deformed: Anatomy) -> None:
    for a, b in zip(rest, deformed, strict=False):
        if a.name != b.name or a.kind is not b.kind:
            raise InputError(
                f"the rest anatomy has {a.kind} {a.name!r} where the deformed one has {b.kind} {b.name!r}; "
                "check the same tissues before and after"
            )
    if len(rest) != len(deformed):
        raise InputError(f"the rest anatomy has {len(rest)} tissues, the deformed one {len(deformed)}; give the same")


def _refusals(names: Iterable[str], *states: tuple[SolidAnatomy, str]) -> tuple[NotChecked, ...]:
    """One entry per tissue that is not a solid, with the first state in which it is none."""
    found = []
    for name in names:
        reasons = [f"{when}: {state.refused[name]}" for state, when in states if name in state.refused]
        if reasons:
            found.append(NotChecked(name, reasons[0]))
    return tuple(found)


def _near_pairs(state: SolidAnatomy, names: Sequence[str]) -> list[Pair]:
    """Pairs of solids whose boxes touch, in the anatomy's order."""
    solid = [name for name in names if name in state.solids]
    return [(solid[i], solid[j]) for i, j in candidate_pairs([state.solids[name].box for name in solid])]


def _largest_first(pairs: Iterable[PairOverlap]) -> tuple[PairOverlap, ...]:
    return tuple(sorted(pairs, key=lambda p: (-p.introduced_mm3, -p.deformed_mm3, -p.rest_mm3, p.a, p.b)))
