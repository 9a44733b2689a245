"""Landmark pairs: points on the body and where they go; where bones are rigid, each by the motion that fits its own."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from musclefit.anatomy.findings import Finding
from musclefit.anatomy.model import Anatomy
from musclefit.errors import LandmarkError, RigError
from musclefit.io.drives.bone_landmarks import handles_of
from musclefit.io.drives.carried_bones import Carried, carriers_named, motion_findings
from musclefit.io.drives.landmark_pairs import read_keyframes, read_pairs
from musclefit.io.drives.pairs import Pairs
from musclefit.rig.bone_fits import (
    RigidPath,
    fit_bones,
    fit_findings,
    half_turn_findings,
    motions_of_fits,
    refuse_mirror_image,
)
from musclefit.rig.chain import ChainMotions, carriers_of
from musclefit.rig.drive import Drive, Driver, Files, JobParts, found_if_named, found_keyframes, register_drive
from musclefit.rig.handles import Handles
from musclefit.rig.handles import Path as HandlePath
from musclefit.rig.job import check_owners
from musclefit.rig.keyframes import PlaceKey, require_moments
from musclefit.rig.paths import ScrewMotions
from musclefit.rig.table_reader import Section
from musclefit.vocabulary import PathKind, Unit


@register_drive
@dataclass(frozen=True, slots=True)
class LandmarkDrive(Drive):
    """Landmark pairs. ``source`` alone: a CSV with target columns; with ``target``: two files matched by name.

    ``units`` is the length unit of files that state none. The columns of positions and of targets start with
    ``source_prefix`` and ``target_prefix``: with "child_" and "adult_" they are ``child_x_mm`` and ``adult_x_mm``.
    Where bones are rigid, ``carried`` holds bones with those (or shell-style patterns for them) that move with them.
    """

    kind: ClassVar[str] = "landmarks"
    paths: ClassVar[frozenset[PathKind]] = frozenset({PathKind.STRAIGHT, PathKind.SCREWS})
    can_hold_bones: ClassVar[bool] = True
    drives: ClassVar[str] = "landmarks drive"

    source: str
    target: str = ""
    units: Unit = Unit.MILLIMETRE
    source_prefix: str = ""
    target_prefix: str = "target_"
    carried: Carried = ()
    keyframes: tuple[PlaceKey, ...] = ()

    def __post_init__(self) -> None:
        require_moments(self.keyframes)

    @classmethod
    def check_table(cls, section: Section) -> None:
        """Raise RigError at a prefix of targets beside a file of its own for them."""
        if "target" in section and "target_prefix" in section:
            raise section.error("target_prefix", "has no effect beside drive.target; remove one of the two")

    def default_path(self, *, rigid_bones: bool) -> PathKind:
        """On chains where bones are rigid."""
        return PathKind.CHAIN if rigid_bones else PathKind.STRAIGHT

    def chains(self, *, rigid_bones: bool) -> bool:
        """Where bones are rigid."""
        return rigid_bones

    def check_bones(self, *, rigid: bool) -> None:
        """Raise RigError where bones are carried and none is rigid."""
        if self.carried and not rigid:
            raise RigError(
                "drive.carried: has no effect where landmarks move no rigid bone; remove it, or write "
                "bones.rigid = true"
            )

    def plain(self) -> LandmarkDrive:
        """Without bones that rigid ones carry."""
        return replace(self, carried=())

    def resolved(self, files: Files) -> LandmarkDrive:
        """With absolute paths."""
        return replace(
            self,
            source=files.find(self.source, key="drive.source"),
            target=found_if_named(self.target, files, key="drive.target"),
            keyframes=found_keyframes(self.keyframes, files),
        )

    def read(self, files: Files, *, path: PathKind, rigid_bones: bool) -> Driver:
        """The pairs; where bones are rigid, the motion of each that fits its own best."""
        prefixes = (self.source_prefix, self.target_prefix)
        table, targets = read_pairs(self.source, self.target, files, units=self.units, prefixes=prefixes)
        keys = read_keyframes(self.keyframes, files, names=table.names, units=self.units, prefixes=prefixes)
        handles, frame = handles_of(table), table.coordinate_system
        if not rigid_bones:
            try:
                refuse_mirror_image(handles.source, targets)
            except LandmarkError as error:
                raise files.named("drive", error) from None
            findings = (*table.findings, *half_turn_findings(handles.source, targets, subject=table.path.name))
            return Pairs(handles, targets, path, findings, frame, keyframes=keys)
        try:
            fits = fit_bones(handles, targets)
        except LandmarkError as error:
            raise files.named("drive", error) from None
        motions = motions_of_fits(fits)
        way = RigidPath(handles, targets, motions)
        return OnFits(self, path, handles, motions, way, (*table.findings, *fit_findings(fits)), frame)


@dataclass(frozen=True, eq=False)
class OnFits(Driver):
    """Landmarks that move their bones rigidly: by the motions that fit best."""

    drive: LandmarkDrive
    path: PathKind
    handles: Handles
    motions: ScrewMotions | ChainMotions
    way: RigidPath
    findings: tuple[Finding, ...]
    frame: str = ""

    def parts(self) -> JobParts:
        """The motions that fit."""
        return JobParts(motions=self.motions)

    def on_anatomy(self, anatomy: Anatomy, files: Files) -> OnFits:
        """With the bones that others carry, and on chains which hang on which."""
        try:
            check_owners(self.handles, anatomy)
        except LandmarkError as error:
            raise files.named("drive", error) from None
        final = self.motions.final
        carried = carriers_named(self.drive.carried, anatomy, files, moving=final)
        final = {**final, **{bone: final[by] for bone, by in carried.items()}}
        motions: ScrewMotions | ChainMotions = ScrewMotions(final)
        if self.path is PathKind.CHAIN:
            motions = ChainMotions(final, carriers_of(anatomy, [final]))
        return replace(self, motions=motions, way=replace(self.way, motions=motions))

    def bone_findings(self, anatomy: Anatomy, files: Files) -> tuple[Finding, ...]:
        """Bones that own no landmark."""
        return motion_findings(
            self.motions, anatomy, subject=files.rig.name, said="own no landmark", code="bone-without-landmarks"
        )

    def handles_on_path(self, anatomy: Anatomy) -> tuple[Handles, HandlePath]:  # noqa: ARG002
        """The landmarks on their bones' motions."""
        return self.handles, self.way
