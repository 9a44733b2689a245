"""Rig tables: takes what a rig file says, gives a `Rig` or an error that names the key; it opens no file.

The layout is that of `rigs/README.md`. Every key is the name of a field of `musclefit.rig.settings`, so a record that
gains a field gains a key.
"""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

from musclefit.anatomy.model import TissueKind
from musclefit.errors import RigError
from musclefit.rig.drive import DRIVES, Drive
from musclefit.rig.keyframes import PlaceKey, PoseKey
from musclefit.rig.methods import settle, with_method
from musclefit.rig.settings import (
    AnatomySource,
    BoneSettings,
    CertificateSettings,
    CompareSettings,
    DeformerSettings,
    Limits,
    MeshSettings,
    Rig,
    SurfaceSettings,
    TetSettings,
    default_purpose,
)
from musclefit.rig.table_reader import Section, suggestion
from musclefit.vocabulary import BackendKind, Compared, Method, PathKind, Purpose, StepKind

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Record = TypeVar("Record", bound="DataclassInstance")

_POSE_SUFFIX = "_deg"


_IDLE_KEYS: Mapping[BackendKind, tuple[str, ...]] = {
    BackendKind.RBF: ("lattice_spacing_mm", "lattice_levels"),
    BackendKind.FFD: ("kernel", "kernel_scale_mm", "smoothing"),
    BackendKind.MULTILEVEL: ("lattice_spacing_mm", "lattice_levels", "smoothing"),
    BackendKind.LATTICE: (
        "kernel",
        "kernel_scale_mm",
        "smoothing",
        "lattice_spacing_mm",
        "lattice_levels",
        "min_steps",
        "degrees_per_step",
        "limit_share",
        "margin_floor",
    ),
}
"""Keys of the deformer that a backend has no use for."""

BOXES_OF_MANY_HANDLES = 150_000
"""Default of ``certificate.max_boxes`` with backend "multilevel": a minute or two of one core for 200,000 handles."""

SECTIONS: Mapping[str, type[DataclassInstance]] = {
    "anatomy": AnatomySource,
    "deformer": DeformerSettings,
    "bones": BoneSettings,
    "surfaces": SurfaceSettings,
    "certificate": CertificateSettings,
    "tets": TetSettings,
    "mesh": MeshSettings,
    "compare": CompareSettings,
    "limits": Limits,
}
"""The sections of a rig and their records; [drive] has one for each kind."""

_OPEN = ("anatomy.kinds", "drive.pose", "drive.carried", "tets.edge_length_mm", "tets.envelope_mm")
"""Tables whose keys the user chooses."""


def parse_rig(table: Mapping[str, Any], *, source: str) -> Rig:
    """Read a rig table.

    Parameters
    ----------
    table : mapping
        As tomllib gives it.
    source : str
        The file, for messages.

    Returns
    -------
    Rig
        With paths as written; what the table leaves out has the default of `musclefit.rig.settings`.

    Raises
    ------
    RigError
        A key or section that does not exist, a value of another type, out of range or not among the allowed, a key that
        would have no effect, or a key that is missing. The message starts with the file and the dotted key.
    """
    root = Section(with_method(table, source=source), source)
    root.refuse_unknown(
        (
            "title",
            "anatomy",
            "drive",
            "deformer",
            "bones",
            "surfaces",
            "certificate",
            "tets",
            "mesh",
            "compare",
            "limits",
        )
    )
    root.require(("title", "anatomy", "drive"))
    title = root.text("title")
    anatomy = _anatomy(root.section("anatomy"))
    drive = _drive(root.section("drive"))
    bones = _record(BoneSettings, _optional(root, "bones"))
    deformer = _deformer(_optional(root, "deformer"), path=drive.default_path(rigid_bones=bones.rigid))
    if deformer.step is StepKind.EXPLICIT and not (bones.keep_rigid or bones.keep_similar):
        section = _optional(root, "deformer")
        if "margin_floor" in section:
            raise section.error(
                "margin_floor", 'has no effect on "explicit" steps, which go as far as their rule allows; remove it'
            )
    if bones.rigid:
        _refuse_lattices_of_handles(_optional(root, "deformer"))
    surfaces = _record(SurfaceSettings, _optional(root, "surfaces"))
    certificate = _certificate(_optional(root, "certificate"), deformer.backend)
    tets = _record(TetSettings, _optional(root, "tets"))
    mesh = _record(MeshSettings, _optional(root, "mesh"))
    compare = _record(CompareSettings, _optional(root, "compare"))
    limits, because = _limits(_optional(root, "limits"), default_purpose(drive, deformer, bones))
    try:
        return Rig(title, anatomy, drive, deformer, bones, surfaces, certificate, tets, mesh, limits, because, compare)
    except RigError as error:
        raise RigError(f"{source}: {error}") from None


def apply_overrides(table: Mapping[str, Any], overrides: Sequence[str], *, source: str) -> dict[str, Any]:
    """A rig table with single values replaced, as `--set` gives them.

    Parameters
    ----------
    table : mapping
        Left as it is.
    overrides : sequence of str
        Each ``key=value``: a dotted key and a TOML value; a value that is not valid TOML, such as ``r3``, is text.
        Another ``deformer.backend`` leaves out the keys of the file that only the file's own backend has a use for.
    source : str
        The file, for messages.

    Raises
    ------
    RigError
        No ``=``, an unknown key, or a value that begins like TOML but is not. Whether the value suits the key is for
        `parse_rig` to say.
    """
    changed: dict[str, Any] = copy.deepcopy(dict(table))
    for override in overrides:
        dotted, equals, text = override.partition("=")
        where = f"{source}: --set {override}"
        if not equals:
            raise RigError(f"{where}: has no '='; write --set key=value, for example --set deformer.max_steps=50")
        path = _override_path(dotted.strip(), where=where)
        value = _override_value(text.strip(), where=where)
        inner = changed
        for part in path[:-1]:
            inner = inner.setdefault(part, {})
            if not isinstance(inner, dict):
                raise RigError(f"{where}: {part} is not a table in the file; correct the file")
        inner[path[-1]] = value
    settle(table, changed, {override.partition("=")[0].strip() for override in overrides})
    _leave_other_backends(changed, overrides)
    return changed


def known_keys() -> tuple[str, ...]:
    """Every dotted key of a rig table; `anatomy.kinds.*` and `drive.pose.*_deg` stand for keys that the user names."""
    anatomy, *others = SECTIONS.items()
    keys = ["title", "drive.kind"]
    for section, records in (
        (anatomy[0], (anatomy[1],)),
        ("drive", tuple(DRIVES.values())),
        *((name, (record,)) for name, record in others),
    ):
        keys += [f"{section}.{field.name}" for record in records for field in fields(record)]
    return tuple(dict.fromkeys(keys))


def _anatomy(section: Section) -> AnatomySource:
    source = _record(AnatomySource, section)
    if source.builtin:
        for key in ("units", "frame", "kinds"):
            if key in section:
                raise section.error(key, "has no effect on a built-in anatomy, which states its own; remove it")
    return source


def _drive(section: Section) -> Drive:
    section.require(("kind",))
    kinds = StrEnum("kinds", [(kind.upper(), kind) for kind in DRIVES])  # type: ignore[misc]
    kind = section.choice("kind", kinds).value
    others = {f.name: other for other in reversed(list(DRIVES)) if other != kind for f in fields(DRIVES[other])}
    known = {f.name for f in fields(DRIVES[kind])}
    for key in section.table:
        if key in others and key not in known:
            raise section.error(
                key, f'belongs to kind "{others[key]}", but the kind is "{kind}"; {suggestion(key, known | {"kind"})}'
            )
    DRIVES[kind].check_table(section)
    return _record(DRIVES[kind], section, besides=("kind",))


def _deformer(section: Section, *, path: PathKind) -> DeformerSettings:
    """The settings; a section that names no path has ``path``."""
    settings = _record(DeformerSettings, section)
    if "path" not in section:
        settings = replace(settings, path=path)
    for key in _IDLE_KEYS[settings.backend]:
        if key in section:
            raise section.error(key, f'has no effect on backend "{settings.backend}"; remove it')
    if settings.step is not StepKind.EXPLICIT and "step_rule" in section:
        of = "" if settings.method is Method.OWN else f' (of deformer.method "{settings.method}")'
        raise section.error(
            "step_rule", f'has no effect on "{settings.step}" steps{of}, which have a rule of their own; remove it'
        )
    return settings


def _refuse_lattices_of_handles(section: Section) -> None:
    """Rigid bones are held by lattices of their own, which those of their handles' field follow from."""
    for key in _IDLE_KEYS[BackendKind.RBF]:
        if key in section:
            raise section.error(key, "has no effect on rigid bones, whose lattices are bones.lattices_mm; remove it")


def _certificate(section: Section, backend: BackendKind) -> CertificateSettings:
    """The proof's settings; with very many handles a box takes long, and the proof is given up sooner."""
    certificate = _record(CertificateSettings, section)
    if backend is BackendKind.MULTILEVEL and "max_boxes" not in section:
        return replace(certificate, max_boxes=BOXES_OF_MANY_HANDLES)
    return certificate


def _limits(section: Section, default: tuple[Purpose, str]) -> tuple[Limits, str]:
    """The limits and why they are for their purpose; numbers in the rig win over the purpose."""
    limits, because = _record(Limits, section), "the rig says so"
    if "purpose" not in section:
        purpose, because = default
        limits = replace(limits, purpose=purpose)
    if limits.purpose is Purpose.ANOTHER_BODY and "bone_rigidity_mm" not in section:
        limits = replace(limits, bone_rigidity_mm=None)
    if limits.purpose is Purpose.ANOTHER_BODY and "muscle_volume_percent" not in section:
        limits = replace(limits, muscle_volume_percent=None)
    return limits, because


def _optional(root: Section, key: str) -> Section:
    return root.section(key) if key in root else Section({}, root.source, key)


def _record(record: type[Record], section: Section, *, besides: tuple[str, ...] = ()) -> Record:
    """The record whose fields the section names; its own checks of range speak with the file's name in front."""
    known: list[str] = [field.name for field in fields(record)]
    section.refuse_unknown([*besides, *known])
    section.require(f.name for f in fields(record) if f.default is MISSING and f.default_factory is MISSING)
    hints = get_type_hints(record)
    values = {key: _value(section, key, hints[key]) for key in known if key in section}
    try:
        return record(**values)
    except RigError as error:
        raise RigError(f"{section.source}: {error}") from None


def _value(section: Section, key: str, hint: Any) -> Any:
    dotted = section.dotted(key)
    if dotted in _TABLES:
        return _TABLES[dotted](section.section(key))
    readers: dict[Any, Callable[[str], Any]] = {
        tuple[PoseKey, ...]: lambda name: tuple(_pose_key(entry) for entry in section.sections(name)),
        tuple[PlaceKey, ...]: lambda name: tuple(_place_key(section, entry) for entry in section.sections(name)),
        str: section.text,
        bool: section.flag,
        int: section.whole,
        int | None: section.whole,
        float: section.number,
        float | None: section.number,
        tuple[str, ...]: lambda name: _listed(section, name),
        tuple[int, ...]: section.wholes,
        tuple[float, ...]: section.numbers,
        tuple[float, ...] | None: section.numbers,
        tuple[Compared, ...]: lambda name: section.choices(name, Compared),
    }
    if hint in readers:
        return readers[hint](key)
    (choice,) = [argument for argument in get_args(hint) if argument is not type(None)] or [hint]
    return section.choice(key, choice)


def _listed(section: Section, key: str) -> tuple[str, ...]:
    values = section.texts(key)
    if not values:
        raise section.error(key, "is an empty list; name at least one")
    return values


def _pose_key(key: Section) -> PoseKey:
    """A keyframe of joint angles."""
    key.require(("at",))
    return PoseKey(key.number("at"), _pose(key, besides=("at",)))


def _place_key(drive: Section, key: Section) -> PlaceKey:
    """A keyframe of places; only a skeleton has a twist."""
    twisted = DRIVES[drive.table["kind"]].twisted
    key.refuse_unknown(("at", "file", "twist_deg") if twisted else ("at", "file"))
    key.require(("at", "file"))
    return PlaceKey(key.number("at"), key.text("file"), key.numbers("twist_deg") if "twist_deg" in key else ())


def _pose(section: Section, *, besides: tuple[str, ...] = ()) -> tuple[tuple[str, float], ...]:
    section.require(besides)
    joints = [key for key in section.table if key not in besides]
    for key in joints:
        if not key.endswith(_POSE_SUFFIX) or key == _POSE_SUFFIX:
            raise section.error(
                key, f"must be the name of a joint and its unit, such as elbow{_POSE_SUFFIX}; angles are in degrees"
            )
    return tuple((key.removesuffix(_POSE_SUFFIX), section.number(key)) for key in joints)


def _leave_other_backends(table: dict[str, Any], overrides: Sequence[str]) -> None:
    """Remove keys that the overriding backend has no use for, unless they are given beside it."""
    given = {override.partition("=")[0].strip() for override in overrides}
    deformer = table.get("deformer")
    if "deformer.backend" not in given or not isinstance(deformer, dict):
        return
    for backend, keys in _IDLE_KEYS.items():
        if deformer.get("backend") == backend.value:
            for key in keys:
                if f"deformer.{key}" not in given:
                    deformer.pop(key, None)


def _override_path(dotted: str, *, where: str) -> list[str]:
    for table in _OPEN:
        if dotted.startswith(f"{table}.") and len(dotted) > len(table) + 1:
            return [*table.split("."), dotted[len(table) + 1 :].strip('"')]
    if dotted not in known_keys():
        inside = [key for key in known_keys() if key.startswith(f"{dotted}.")]
        if inside:
            raise RigError(f"{where}: {dotted} is a section; set one of its keys: {', '.join(inside)}")
        raise RigError(f"{where}: unknown key {dotted!r}; {suggestion(dotted, known_keys())}")
    return dotted.split(".")


def _override_value(text: str, *, where: str) -> Any:
    try:
        read = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError) as error:  # TOMLDecodeError, or a number with more digits than Python converts
        if not text or text[0] in "\"'[{":
            raise RigError(
                f"{where}: the value is not valid TOML: {error}; write a number, true or false, a word, or quoted text"
            ) from None
        return text
    if set(read) != {"value"}:
        raise RigError(f"{where}: the value holds more than one line; set one key at a time")
    return read["value"]


def _lengths(lengths: Section) -> tuple[tuple[str, float], ...]:
    return tuple((pattern, lengths.number(pattern)) for pattern in lengths.table)


_TABLES: dict[str, Callable[[Section], Any]] = {
    "drive.pose": _pose,
    "anatomy.kinds": lambda kinds: tuple((pattern, kinds.choice(pattern, TissueKind)) for pattern in kinds.table),
    "drive.carried": lambda carried: tuple((carrier, _listed(carried, carrier)) for carrier in carried.table),
    "tets.edge_length_mm": _lengths,
    "tets.envelope_mm": _lengths,
}
"""Keys whose values are tables with names of the user's own."""
