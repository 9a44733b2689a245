"""A surface that a boolean cut -> one fit to be bent, free of crossings, crumbs, thin walls, slivers and contacts."""

from __future__ import annotations

from dataclasses import dataclass, field

from musclefit.anatomy.repair.records import Change, RepairSettings
from musclefit.anatomy.repair.surface import tidied
from musclefit.geometry.measures import enclosed_volume
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.faults import faults_of
from musclefit.geometry.surfaces.self_clearance import with_self_clearance
from musclefit.geometry.surfaces.slivers import without_slivers
from musclefit.geometry.surfaces.thin_walls import thin_places, without_thin_places

SMOOTH = 0.1
"""How far a place of a cut surface may move for vertices that it can do without, in clearances."""

RELAX = 0.25
"""How far a vertex may be moved where triangles of a cut surface cross, in clearances."""

SLIVER, SLIVER_MOVED = 0.1, 0.25
"""Height below which a triangle is a sliver, and how far a place may move for it to go, in clearances."""

SHEETS = 0.1
"""Width, in clearances, that parts of a surface keep from each other, at whatever angle they meet: what is
closer crosses as soon as it is bent. It is made by moving vertices no farther than ``RELAX``."""

WALL_ROUNDS = 3
"""How often thin walls are cut out: a cut may leave others."""

MOST_WALL_PERCENT = 1.0
"""Of a tissue's volume: where its thin places make up more, it is thin by nature and left as it is."""


MOST_TRIANGLES = 4000
"""Thin triangles of a tissue that are cut out at most, each with its surroundings: some 5 s of work."""


@dataclass(slots=True)
class Log:
    """What was tidied of one tissue, in one sum for thin places and one for slivers."""

    changes: list[Change] = field(default_factory=list)
    thin_places: int = 0
    thin_area_mm2: float = 0.0
    thin_volume_mm3: float = 0.0
    slivers: int = 0
    moved_mm: float = 0.0
    parted: int = 0
    parted_mm: float = 0.0
    folds: int = 0
    folds_filled: int = 0

    def said(self, settings: RepairSettings) -> tuple[Change, ...]:
        """All of it as changes."""
        said = list(self.changes)
        if self.thin_places:
            message = (
                f"cut out walls and slots narrower than {settings.wall_mm:g} mm: {self.thin_area_mm2:.3g} mm² of their "
                f"sides, {self.thin_volume_mm3:.3g} mm³ with the surroundings"
            )
            said.append(Change("thin-walls", self.thin_places, message, self.thin_area_mm2, self.thin_volume_mm3))
        if self.slivers:
            message = (
                f"took out {self.slivers} triangles lower than {SLIVER * settings.clearance_mm:.3g} mm, moving places "
                f"by up to {self.moved_mm:.3f} mm"
            )
            said.append(Change("slivers", self.slivers, message))
        if self.parted or self.folds:
            message = (
                f"moved {self.parted} vertices by up to {self.parted_mm:.3f} mm where the surface was closer to itself "
                f"than {SHEETS * settings.clearance_mm:.3g} mm"
            )
            if self.folds:
                message += f"; took out {self.folds} triangles of folds and fins, and filled in {self.folds_filled}"
            said.append(Change("parted-sheets", self.parted + self.folds, message))
        return tuple(said)


def finished(cut: TriMesh, log: Log, *, settings: RepairSettings) -> TriMesh:
    """Tidy what a boolean left of a surface; without triangles where that is nothing."""
    mesh, changes = tidied(cut, settings=settings, most_mm=RELAX * settings.clearance_mm)
    log.changes += changes
    if not len(mesh.faces):
        return mesh
    mesh = without_thin_walls(mesh, log, settings=settings)
    least, most = SLIVER * settings.clearance_mm, SLIVER_MOVED * settings.clearance_mm
    done = without_slivers(mesh, least_mm=least, most_mm=most)
    log.slivers += done.slivers - done.left
    log.moved_mm = max(log.moved_mm, done.moved_mm)
    return without_contacts(done.mesh, log, settings=settings)


def without_contacts(mesh: TriMesh, log: Log, *, settings: RepairSettings) -> TriMesh:
    """The very same surface where no parts of it all but touch each other."""
    clearance = settings.clearance_mm
    done = with_self_clearance(mesh, width_mm=SHEETS * clearance, most_mm=RELAX * clearance)
    log.parted += done.moved
    log.parted_mm = max(log.parted_mm, done.moved_mm)
    log.folds += done.removed
    log.folds_filled += done.filled
    return done.mesh


def without_thin_walls(mesh: TriMesh, log: Log, *, settings: RepairSettings) -> TriMesh:
    """The very same surface where none of its walls and slots is too narrow, or most of it is."""
    start = enclosed_volume(mesh)
    for _ in range(WALL_ROUNDS):
        found = thin_places(mesh, width_mm=settings.wall_mm)
        by_nature = 0.5 * found.area_mm2 * settings.wall_mm > 0.01 * MOST_WALL_PERCENT * start
        if not found.thin.any() or by_nature or len(found.covering().faces) > MOST_TRIANGLES:
            break
        smooth = SMOOTH * settings.clearance_mm
        left = without_thin_places(mesh, found, width_mm=settings.wall_mm, smooth_within_mm=smooth)
        if not len(left.faces):
            break
        trial, changes = tidied(left, settings=settings, most_mm=RELAX * settings.clearance_mm)
        lost = start - enclosed_volume(trial)
        if not len(trial.faces) or lost > 0.01 * MOST_WALL_PERCENT * start or not faults_of(trial).none:
            break
        log.thin_places += int(found.thin.sum())
        log.thin_area_mm2 += found.area_mm2
        log.thin_volume_mm3 += enclosed_volume(mesh) - enclosed_volume(trial)
        log.changes += changes
        mesh = trial
    return mesh
