"""A rig as a value: anatomy, driver, deformer, tetrahedra, limits; every setting has its unit, default and range here.

It takes settings and gives records whose values are in range; it knows neither files nor the layout of a rig table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from itertools import pairwise
from types import MappingProxyType

from musclefit.anatomy.mesh_rules import Gaps
from musclefit.anatomy.model import TissueKind
from musclefit.errors import RigError
from musclefit.fields.kernels import KERNELS, kernel_named
from musclefit.rig.drive import Drive, at_least_one
from musclefit.rig.table_reader import suggestion
from musclefit.vocabulary import (
    BackendKind,
    Compared,
    Method,
    PathKind,
    Purpose,
    StepKind,
    StepRule,
    TestedAt,
    Unit,
)


@dataclass(frozen=True, slots=True)
class AnatomySource:
    """Where the tissues come from: ``builtin`` names a generated anatomy, else a folder or files.

    ``kinds`` maps tissue names (or shell-style patterns) to kinds, ahead of what the file names say; the first
    pattern that fits counts. ``units`` is the length unit of the files. ``points`` are further files whose points the
    deformation takes along: landmarks, markers, meshes.

    Raises
    ------
    RigError
        Not exactly one of ``builtin``, ``folder`` and ``files``.
    """

    builtin: str = ""
    folder: str = ""
    files: tuple[str, ...] = ()
    units: Unit = Unit.MILLIMETRE
    frame: str = "as in the files"
    kinds: tuple[tuple[str, TissueKind], ...] = ()
    points: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        given = [key for key in ("builtin", "folder", "files") if getattr(self, key)]
        if len(given) != 1:
            found = " and ".join(given) if given else "none"
            raise RigError(f"anatomy: found {found} of builtin, folder and files; give exactly one of them")


@dataclass(frozen=True, slots=True)
class DeformerSettings:
    """Which field, which steps, how many.

    ``method`` names the method that the other settings, and those of the bones, make up; see `METHOD_SETTINGS`.
    The path is cut into at least ``min_steps`` stretches, and into so many that in none a joint turns by more than
    ``degrees_per_step``; no step uses more than ``limit_share`` of its rule's limit, and an implicit one keeps at least
    ``margin_floor`` of it: where it kept next to nothing, other points between those tested are likely to fail.
    ``kernel`` is for radial sums, by its name (`musclefit.fields.kernels`), ``kernel_scale_mm`` its own length where it
    has one: support, width or mollifier. ``lattice_spacing_mm`` (of the coarsest lattice) and ``lattice_levels``
    (lattices at most, each of half the spacing of the one before) are for free-form deformation by handles.
    ``smoothing`` lets radial sums miss noisy handles: it is added to the diagonal of the kernel's matrix.

    Raises
    ------
    RigError
        ``max_steps``, ``min_steps`` or ``lattice_levels`` below 1, a negative smoothing, a share that is not in (0, 1],
        a floor that is not in [0, 1), an angle that is not in (0, 360], or a spacing that is not positive and finite.
    """

    method: Method = Method.OWN
    backend: BackendKind = BackendKind.RBF
    kernel: str = "r2logr"
    kernel_scale_mm: float | None = None
    step: StepKind = StepKind.EXPLICIT
    step_rule: StepRule = StepRule.ROW_NORM
    tested_at: TestedAt = TestedAt.ALL_POINTS
    path: PathKind = PathKind.STRAIGHT
    max_steps: int = 200
    min_steps: int = 1
    degrees_per_step: float = 360.0
    limit_share: float = 1.0
    margin_floor: float = 0.2
    lattice_spacing_mm: float = 20.0
    lattice_levels: int = 6
    smoothing: float = 0.0

    def __post_init__(self) -> None:
        _require_kernel(self.kernel, self.kernel_scale_mm)
        at_least_one("deformer.max_steps", self.max_steps)
        at_least_one("deformer.min_steps", self.min_steps)
        if not 0.0 < self.degrees_per_step <= 360.0:
            raise RigError(
                f"deformer.degrees_per_step: found {self.degrees_per_step}; expected an angle above 0 and up to 360 deg"
            )
        if not 0.0 < self.limit_share <= 1.0:
            raise RigError(f"deformer.limit_share: found {self.limit_share}; expected a share above 0 and up to 1")
        if not 0.0 <= self.margin_floor < 1.0:
            raise RigError(f"deformer.margin_floor: found {self.margin_floor}; expected a share of at least 0, below 1")
        at_least_one("deformer.lattice_levels", self.lattice_levels)
        if not 0.0 <= self.smoothing < math.inf:
            raise RigError(f"deformer.smoothing: found {self.smoothing}; expected a finite number of at least 0")
        if not 0.0 < self.lattice_spacing_mm < math.inf:
            raise RigError(
                f"deformer.lattice_spacing_mm: found {self.lattice_spacing_mm}; expected a finite spacing above 0"
            )

    @property
    def share(self) -> float:
        """How much of its rule's limit a step of this kind may use."""
        return self.limit_share if self.step is StepKind.EXPLICIT else self.cayley_share

    @property
    def cayley_share(self) -> float:
        """How much of its rule's limit an implicit step may use."""
        return min(self.limit_share, 1.0 - self.margin_floor)


@dataclass(frozen=True, slots=True)
class BoneSettings:
    """Whether bones are moved by their rigid motions and the field brought to agree with them, and how.

    Lengths and numbers that are None are chosen from the sizes of the bones (`musclefit.pipeline.chosen_settings`).
    ``handle_spacing_mm`` is how far apart the handles are that are spread over the bones beside the rig's landmarks.
    ``lattices_mm`` are the spacings of the lattices of the part of the field that holds rigid bones,
    ``kept_lattices_mm`` those of the corrections that hold kept ones, wide to narrow. Places of a bone that come closer
    than ``contact_zone_mm`` to a bone that moves otherwise are its contact zone: there the field may slip along it.
    ``lock`` makes the field exactly a rigid or kept bone's motion on its whole surface (`musclefit.fields.locked`).

    Where no joint moves them, ``keep_rigid`` and ``keep_similar`` name bones (or shell-style patterns) that may only
    move rigidly, or only move and change their size: each gets the motion that fits the map best, and the field is
    brought into line with it. A bone that both name is kept rigid.

    Raises
    ------
    RigError
        A length that is not positive and finite, spacings that rise, or bones kept both ways.
    """

    rigid: bool = False
    handle_spacing_mm: float | None = None
    lattices_mm: tuple[float, ...] | None = None
    iterations: int | None = None
    kept_lattices_mm: tuple[float, ...] = (40.0, 20.0, 10.0, 5.0)
    contact_zone_mm: float | None = None
    lock: bool = False
    keep_rigid: tuple[str, ...] = ()
    keep_similar: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.iterations is not None:
            at_least_one("bones.iterations", self.iterations)
        if self.rigid and (self.keep_rigid or self.keep_similar):
            raise RigError(
                "bones.keep_rigid and keep_similar: have no effect beside bones.rigid, which moves bones already; "
                "remove them"
            )
        if self.lock and not (self.rigid or self.keep_rigid or self.keep_similar):
            raise RigError(
                "bones.lock: locks rigid and kept bones, but bones.rigid is false and nothing is kept; set "
                "bones.rigid, keep_rigid or keep_similar, or remove lock"
            )
        lengths = {"handle_spacing_mm": self.handle_spacing_mm, "contact_zone_mm": self.contact_zone_mm}
        widths = {"lattices_mm": self.lattices_mm, "kept_lattices_mm": self.kept_lattices_mm}
        each = [(key, value) for key, values in widths.items() for value in values or ()]
        for key, value in (*lengths.items(), *each):
            if value is not None and not 0.0 < value < math.inf:
                raise RigError(f"bones.{key}: found {value}; expected a finite length above 0, in mm")
        for key, values in widths.items():
            if values is not None and (not values or any(b > a for a, b in pairwise(values))):
                raise RigError(
                    f"bones.{key}: found {list(values)}; expected one length or more, none above the one before, in mm"
                )


@dataclass(frozen=True, slots=True)
class SurfaceSettings:
    """Whether surfaces are cut finer where the map bends their triangles.

    Edges whose middle would be off the map by more than ``chord_tolerance_mm`` are split, and so are all that are
    longer than ``longest_edge_mm``. What is None is chosen from the anatomy.

    Raises
    ------
    RigError
        A length that is not positive and finite.
    """

    refine: bool = False
    chord_tolerance_mm: float | None = None
    longest_edge_mm: float | None = None

    def __post_init__(self) -> None:
        for key in ("chord_tolerance_mm", "longest_edge_mm"):
            value = getattr(self, key)
            if value is not None and not 0.0 < value < math.inf:
                raise RigError(f"surfaces.{key}: found {value}; expected a finite length above 0, in mm")


@dataclass(frozen=True, slots=True)
class CertificateSettings:
    """Whether to prove that the map is one-to-one inside the skin, and how many boxes of space that may take.

    Raises
    ------
    RigError
        ``max_boxes`` below 1.
    """

    enabled: bool = True
    max_boxes: int = 6_000_000

    def __post_init__(self) -> None:
        at_least_one("certificate.max_boxes", self.max_boxes)


@dataclass(frozen=True, slots=True)
class TetSettings:
    """Tetrahedralisation, as `anatomy.layers.LayerRules` says it; fractions are of the bounding box's diagonal.

    Filler between bones that slide past each other is left out where it is within ``joint_space_mm`` of both, if the
    rig holds bones rigid; 0 leaves none out.

    Raises
    ------
    RigError
        A fraction that is not between 0 and 1, a length that is not positive and finite, or a negative joint space.
    """

    enabled: bool = False
    edge_length_fraction: float = 0.03
    envelope_fraction: float = 7e-4
    edge_length_mm: tuple[tuple[str, float], ...] = ()
    envelope_mm: tuple[tuple[str, float], ...] = ()
    priority: tuple[str, ...] = (TissueKind.BONE.value, TissueKind.MUSCLE.value, TissueKind.OTHER.value)
    gaps: Gaps = Gaps.NONE
    gap_ratio: float = 4.0
    gap_edge_mm: float = 2.0
    joint_space_mm: float = 4.0

    def __post_init__(self) -> None:
        for key in ("edge_length_fraction", "envelope_fraction"):
            value = getattr(self, key)
            if not 0.0 < value < 1.0:
                raise RigError(
                    f"tets.{key}: found {value}; expected a fraction of the bounding-box diagonal between 0 and 1, "
                    "both excluded"
                )
        own = [(f"edge_length_mm.{name}", length) for name, length in self.edge_length_mm]
        own += [(f"envelope_mm.{name}", length) for name, length in self.envelope_mm]
        for key, length in (*own, ("gap_ratio", self.gap_ratio), ("gap_edge_mm", self.gap_edge_mm)):
            if not 0.0 < length < math.inf:
                raise RigError(f"tets.{key}: found {length}; expected a finite number above 0")
        if not 0.0 <= self.joint_space_mm < math.inf:
            raise RigError(f"tets.joint_space_mm: found {self.joint_space_mm}; expected a finite length of at least 0")


@dataclass(frozen=True, slots=True)
class MeshSettings:
    """What is done about tetrahedra that a one-to-one map leaves inverted, and which are named before it starts.

    ``refine`` splits edges of tets that come out inverted, or whose boundary faces cross, in at most ``max_rounds``
    rounds and up to ``max_growth`` times the tets given. Tets with an angle between two faces below ``sliver_deg``, or
    above 180 less that, are named before the deformation.

    Where bones are held rigid, or splitting does not end well, ``move_vertices`` moves vertices off the map.

    Raises
    ------
    RigError
        No round, a growth below 1, or an angle that is not between 0 and 60 degrees.
    """

    refine: bool = True
    move_vertices: bool = True
    max_rounds: int = 120
    max_growth: float = 1.5
    sliver_deg: float = 1.0

    def __post_init__(self) -> None:
        at_least_one("mesh.max_rounds", self.max_rounds)
        if not 1.0 <= self.max_growth < math.inf:
            raise RigError(f"mesh.max_growth: found {self.max_growth}; expected a finite factor of at least 1")
        if not 0.0 <= self.sliver_deg < 60.0:
            raise RigError(f"mesh.sliver_deg: found {self.sliver_deg}; expected an angle of 0 up to 60 degrees")


@dataclass(frozen=True, slots=True)
class CompareSettings:
    """What a result is shown beside: the paper's loop, where the method is not that loop itself, and one step."""

    methods: tuple[Compared, ...] = (Compared.YU2014, Compared.ONE_SHOT)


HELD_RIGIDITY_MM = 0.01
"""How far a bone that is held or kept may be off its rigid motion, whatever the purpose."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What a run must keep to pass.

    ``introduced_overlap_mm3`` is for pairs that are apart at rest, ``grown_overlap_mm3`` for those that overlap at
    rest: what they share beyond that overlap carried along.

    ``purpose`` decides what the limits of bones and muscles are where nobody says them: another body has other bones
    and other muscles, so that these have none then (None), and are told as measured. Bones that are held or kept are
    held against ``held_rigidity_mm`` all the same.

    Raises
    ------
    RigError
        A limit below 0 or not finite.
    """

    purpose: Purpose = Purpose.POSING
    landmark_mm: float = 1e-6
    bone_rigidity_mm: float | None = 0.01
    muscle_volume_percent: float | None = 1.0
    introduced_overlap_mm3: float = 1.0
    grown_overlap_mm3: float = 1.0
    introduced_outside_skin_mm3: float = 1.0
    inverted_tets: int = 0

    def __post_init__(self) -> None:
        for name, value in self.numbers.items():
            if value is not None and not 0 <= value < math.inf:
                raise RigError(f"limits.{name}: found {value}; expected a finite limit of at least 0")

    @property
    def numbers(self) -> Mapping[str, float | None]:
        """The limits by name; None for no limit."""
        return {limit.name: getattr(self, limit.name) for limit in fields(self) if limit.name != "purpose"}

    @property
    def held_rigidity_mm(self) -> float:
        """The limit of bones that are held or kept, which others may have none."""
        return HELD_RIGIDITY_MM if self.bone_rigidity_mm is None else self.bone_rigidity_mm


METHOD_SETTINGS: Mapping[Method, Mapping[str, tuple[object, ...]]] = MappingProxyType(
    {
        Method.OWN: MappingProxyType({}),
        Method.YU2014: MappingProxyType(
            {
                "deformer.backend": (BackendKind.RBF,),
                "deformer.kernel": ("r2logr", "r", "r3"),
                "deformer.step": (StepKind.EXPLICIT,),
                "deformer.step_rule": (StepRule.ROW_NORM,),
                "deformer.path": (PathKind.STRAIGHT,),
                "bones.rigid": (False,),
                "bones.keep_rigid": ((),),
                "bones.keep_similar": ((),),
            }
        ),
        Method.RIGID_BONES: MappingProxyType(
            {
                "deformer.backend": (BackendKind.RBF, BackendKind.FFD),
                "deformer.step": (StepKind.CAYLEY,),
                "deformer.tested_at": (TestedAt.ALL_POINTS,),
                "deformer.path": (PathKind.JOINTS, PathKind.CHAIN, PathKind.SCREWS),
                "deformer.smoothing": (0.0,),
                "bones.rigid": (True,),
            }
        ),
    }
)
"""What a method's settings may be; all others are free."""


def require_method(method: Method, values: Mapping[str, object]) -> None:
    """Raise RigError at the first of some settings, by their dotted keys, that is not the method's."""
    for key, allowed in METHOD_SETTINGS[method].items():
        if key in values and values[key] not in allowed:
            either = " or ".join(_as_toml(value) for value in allowed)
            raise RigError(
                f'deformer.method: "{method}" and {key} = {_as_toml(values[key])} exclude each other, the method has '
                f"{either}; change {key} or the method"
            )


def _as_toml(value: object) -> str:
    """A setting as a rig writes it."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(_as_toml(item) for item in value)}]"
    return f'"{value}"' if isinstance(value, str) else str(value).lower()


@dataclass(frozen=True, slots=True)
class Rig:
    """Everything one run needs, as written in a rig file; paths are as resolved by the reader.

    ``purpose_because`` says why the limits are for the purpose that they name.

    Raises
    ------
    RigError
        No title, settings that are not those of the method named, or handles that shall follow joints where no joint
        drives.
    """

    title: str
    anatomy: AnatomySource
    drive: Drive
    deformer: DeformerSettings = field(default_factory=DeformerSettings)
    bones: BoneSettings = field(default_factory=BoneSettings)
    surfaces: SurfaceSettings = field(default_factory=SurfaceSettings)
    certificate: CertificateSettings = field(default_factory=CertificateSettings)
    tets: TetSettings = field(default_factory=TetSettings)
    mesh: MeshSettings = field(default_factory=MeshSettings)
    limits: Limits = field(default_factory=Limits)
    purpose_because: str = field(default="the rig says so", compare=False)
    compare: CompareSettings = field(default_factory=CompareSettings)

    def __post_init__(self) -> None:
        if not self.title.strip():
            raise RigError("title: is empty; say in a few words what the rig does")
        drive, rigid = self.drive, self.bones.rigid
        if self.deformer.path is PathKind.JOINTS and PathKind.JOINTS not in drive.paths:
            raise RigError(
                f'deformer.path: found "{PathKind.JOINTS}", but no joint drives this rig; write "{PathKind.STRAIGHT}", '
                'or a [drive] of kind "joints"'
            )
        _require_path(self.drive, self.deformer.path)
        if self.deformer.path is PathKind.CHAIN and not drive.chains(rigid_bones=rigid):
            raise RigError(
                f'deformer.path: found "{PathKind.CHAIN}", but neither transforms nor landmarks of rigid bones drive '
                f'this rig; write "{drive.through}"'
            )
        if self.deformer.degrees_per_step < 360.0 and not (drive.turns_bones or rigid):
            raise RigError("deformer.degrees_per_step: has no effect where no bone turns; remove it, or use min_steps")
        if self.bones.rigid and self.deformer.smoothing:
            raise RigError("deformer.smoothing: rigid bones are met exactly; remove it, or write bones.rigid = false")
        if self.deformer.backend is BackendKind.LATTICE and (
            not drive.by_control_points
            or self.deformer.step is not StepKind.EXPLICIT
            or self.deformer.step_rule is not StepRule.ROW_NORM
        ):
            raise RigError(
                f'deformer.backend: found "{BackendKind.LATTICE}", the control points\' own loop: it needs a [drive] '
                f'of kind "lattice", step "{StepKind.EXPLICIT}" and step_rule "{StepRule.ROW_NORM}"; else write '
                f'"{BackendKind.FFD}" or "{BackendKind.RBF}"'
            )
        if self.deformer.backend is BackendKind.MULTILEVEL:
            _require_many_handles(self.deformer, self.bones)
        drive.check_bones(rigid=rigid)
        if self.bones.rigid:
            _require_rigid_bones(self.drive, self.deformer)
        elif self.bones.lock:
            _require_locking_march(self.deformer)
        dotted = (key.partition(".") for key in METHOD_SETTINGS[self.deformer.method])
        settings = {f"{part}.{name}": getattr(getattr(self, part), name) for part, _, name in dotted}
        require_method(self.deformer.method, settings)


def _require_many_handles(deformer: DeformerSettings, bones: BoneSettings) -> None:
    """Raise RigError unless very many handles can be followed: by a scalar kernel without end, bones left to it."""
    kernel = kernel_named(deformer.kernel)
    if kernel.isochoric or kernel.compact:
        raise RigError(
            f'deformer.kernel: found "{deformer.kernel}"; backend "{BackendKind.MULTILEVEL}" refines a scalar kernel '
            'that reaches everywhere: write "r", "r2logr" or "r3"'
        )
    if bones.rigid or bones.keep_rigid or bones.keep_similar:
        raise RigError(
            f'deformer.backend: found "{BackendKind.MULTILEVEL}", which holds no bones; write "{BackendKind.RBF}" or '
            f'"{BackendKind.FFD}", or leave bones.rigid, keep_rigid and keep_similar out'
        )


def _require_locking_march(deformer: DeformerSettings) -> None:
    """Raise RigError unless the deformer can lock kept bones: by implicit steps that are tested everywhere."""
    if (
        deformer.step is not StepKind.CAYLEY
        or deformer.tested_at is not TestedAt.ALL_POINTS
        or deformer.backend is BackendKind.LATTICE
    ):
        raise RigError(
            f'bones.lock: found step "{deformer.step}", tested_at "{deformer.tested_at}" and backend '
            f'"{deformer.backend}"; kept bones are locked by step "{StepKind.CAYLEY}", tested_at '
            f'"{TestedAt.ALL_POINTS}" and backend "{BackendKind.RBF}" or "{BackendKind.FFD}"; write these, or '
            "lock = false"
        )


def default_purpose(drive: Drive, deformer: DeformerSettings, bones: BoneSettings) -> tuple[Purpose, str]:
    """What a rig is for that does not say it, and why."""
    if bones.rigid:
        return Purpose.POSING, "bones are rigid"
    if drive.poses_because:
        return Purpose.POSING, drive.poses_because
    if deformer.path is PathKind.SCREWS:
        return Purpose.POSING, "bones go on screws"
    if deformer.backend is BackendKind.RBF and kernel_named(deformer.kernel).isochoric:
        return Purpose.POSING, f"{drive.drives} by a kernel that keeps volume"
    return Purpose.ANOTHER_BODY, f"{drive.drives} by a field that may change volume"


def _require_rigid_bones(drive: Drive, deformer: DeformerSettings) -> None:
    """Raise RigError unless the drive says rigid motions of bones and the deformer can follow them."""
    if not drive.can_hold_bones:
        raise RigError(
            "bones.rigid: nothing says how bones move rigidly; use a [drive] of joints, of transforms, or of landmarks "
            "that name their bones, or keep bones from bending with bones.keep_rigid"
        )
    path = PathKind.JOINTS if PathKind.JOINTS in drive.paths else PathKind.CHAIN
    if (
        deformer.path is PathKind.STRAIGHT
        or deformer.step is not StepKind.CAYLEY
        or deformer.tested_at is not TestedAt.ALL_POINTS
    ):
        raise RigError(
            f'bones.rigid: bones move rigidly: write deformer.path = "{path}", step = "{StepKind.CAYLEY}" and '
            f'tested_at = "{TestedAt.ALL_POINTS}", or bones.rigid = false'
        )


def _require_path(drive: Drive, path: PathKind) -> None:
    """Raise RigError where the drive has no such path, or keyframes that the path would not go through."""
    if drive.way and path not in drive.paths:
        raise RigError(f'deformer.path: has no effect on a drive of kind "{drive.kind}", which bends; remove it')
    if path is PathKind.SCREWS and PathKind.SCREWS not in drive.paths:
        raise RigError(
            'deformer.path: only joints, transforms and landmarks know bones that could go on screws; write "straight"'
        )
    if drive.moments and path is not drive.through:
        raise RigError(
            f'drive.keyframes: have no effect on path "{path}"; write deformer.path = "{drive.through}" or remove them'
        )


def _require_kernel(name: str, scale_mm: float | None) -> None:
    """Raise RigError unless there is such a kernel, and its length is given where it has one and nowhere else."""
    if name not in KERNELS:
        raise RigError(f"deformer.kernel: found {name!r}; {suggestion(name, KERNELS)}")
    scaled = KERNELS[name].scaled
    if scaled and scale_mm is None:
        raise RigError(
            f"deformer.kernel_scale_mm: is missing; kernel {name!r} has a length of its own (its support, width or "
            "mollifier): give it in mm, some times the distance between handles"
        )
    if not scaled and scale_mm is not None:
        raise RigError(f"deformer.kernel_scale_mm: has no effect: kernel {name!r} has no length of its own; remove it")
    if scale_mm is not None and not 0.0 < scale_mm < math.inf:
        raise RigError(f"deformer.kernel_scale_mm: found {scale_mm}; expected a finite length above 0, in mm")
