"""Study files: takes the path of a study, gives its cases (subjects x rigs x motions) and what each depends on."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any

from musclefit.errors import InputError, RigError
from musclefit.io.formats.rows import csv_lines
from musclefit.io.formats.tables import parse_toml, toml_string
from musclefit.io.named_files import resolve_data
from musclefit.io.rig_names import find_rig
from musclefit.io.run_folder import file_names
from musclefit.rig.rig_table import apply_overrides
from musclefit.rig.table_reader import Section, suggestion

SUBJECT, RIG, MOTION = "subject", "rig", "motion"
"""Columns of a table of subjects that are neither rig keys nor facts about a subject."""

_BIDS_SUBJECT = "participant_id"
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
_HASHED_SECTIONS = ("anatomy", "drive")
"""Sections of a rig that name files."""


@dataclass(frozen=True, slots=True)
class Case:
    """One subject in one rig, and along one motion where there are motions.

    Parameters
    ----------
    name : str
        Subject and rig (and motion) as the folders of the case, such as "sub-01/bent": unique, and safe as a path.
    subject, rig, motion : str
        As the study writes them; no motion is "".
    rig_file : Path
    motion_file : Path or None
    overrides : tuple of str
        ``key=value`` each, as `musclefit run --set` takes them.
    facts : mapping of str to str
        What the table says about the subject beside rig keys.
    """

    name: str
    subject: str
    rig: str
    motion: str
    rig_file: Path
    motion_file: Path | None
    overrides: tuple[str, ...]
    facts: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Study:
    """A study that was read: its cases, and how each is run.

    Parameters
    ----------
    title : str
    source : Path
    cases : tuple of Case
    pictures : bool
        Whether each run is drawn.
    tets : bool or None
        Whether tetrahedra are made, whatever the rigs say; None for what they say.
    frames : int
        Of each motion; 0 for what the rigs say.
    """

    title: str
    source: Path
    cases: tuple[Case, ...]
    pictures: bool = True
    tets: bool | None = None
    frames: int = 0

    def case(self, name: str) -> Case:
        """The case of a name.

        Raises
        ------
        InputError
            None is called so.
        """
        for case in self.cases:
            if case.name == name:
                return case
        raise InputError(
            f"{self.source}: no case is named {name!r}; {suggestion(name, [case.name for case in self.cases])}"
        )


def read_study(path: str | Path) -> Study:
    """Read a study file and the table or the folders of subjects that it names.

    Raises
    ------
    RigError
        The file or the table is broken, names what is not there, or a rig refuses a key that the study sets.
    """
    source = Path(path)
    try:
        data = source.read_bytes()
    except OSError as error:
        raise RigError(f"{source}: cannot be read: {error.strerror or error}; give the path of a study") from None
    study = Section(parse_toml(data, source=str(source)), str(source))
    study.refuse_unknown(("title", "subjects", "rigs", "motions", "set", "run"))
    study.require(("subjects", "rigs"))
    rigs = _named_paths(study.section("rigs"), source, rigs=True)
    if not rigs:
        raise study.error("rigs", 'is empty; name a rig, such as bent = "bent.toml"')
    motions = _named_paths(study.section("motions"), source, rigs=False) if "motions" in study else {}
    how = study.section("run") if "run" in study else Section({}, str(source), "run")
    how.refuse_unknown(("pictures", "tets", "frames"))
    templates = dict(_flat(study.section("set"))) if "set" in study else {}
    cases = tuple(_cases(_subjects(study.section("subjects"), source), rigs, motions, templates, source))
    frames = how.whole("frames") if "frames" in how else 0
    if frames and not motions:
        raise how.error("frames", "has no effect without [motions]; remove it, or name a motion")
    return Study(
        title=study.text("title") if "title" in study else source.stem,
        source=source,
        cases=cases,
        pictures=how.flag("pictures") if "pictures" in how else True,
        tets=how.flag("tets") if "tets" in how else None,
        frames=frames,
    )


@dataclass(slots=True)
class FileHashes:
    """SHA-256 of files, each read once while its size and time stay the same."""

    known: dict[tuple[str, int, int], str] = field(default_factory=dict)

    def of(self, path: Path) -> str:
        """The hash of a file's bytes."""
        about = path.stat()
        key = str(path), about.st_size, about.st_mtime_ns
        if key not in self.known:
            self.known[key] = sha256(path.read_bytes()).hexdigest()
        return self.known[key]


def inputs_of(case: Case, hashes: FileHashes) -> dict[str, str]:
    """SHA-256 of every file that a case names, by where it lies.

    Raises
    ------
    RigError
        As `input_files`.
    """
    return {str(file): hashes.of(file) for file in input_files(case)}


def input_files(case: Case) -> list[Path]:
    """The files that a case names: rig, motion, and what the rig's values name.

    A value that names a folder stands for the files in it; a pattern, for those that it fits.

    Raises
    ------
    RigError
        The rig file is missing or broken, or refuses a key.
    """
    rig = case.rig_file
    try:
        table = parse_toml(rig.read_bytes(), source=str(rig))
    except OSError as error:
        raise RigError(f"{rig}: cannot be read: {error.strerror or error}; correct the study's [rigs]") from None
    table = apply_overrides(table, case.overrides, source=str(rig))
    motion = [case.motion_file] if case.motion_file is not None and case.motion_file.is_file() else []
    named = [file for part in _HASHED_SECTIONS for text in _texts(table.get(part, {})) for file in _files(text, rig)]
    return [rig, *motion, *dict.fromkeys(named)]


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _texts(item)
    elif isinstance(value, list):
        for item in value:
            yield from _texts(item)


def _files(text: str, rig: Path) -> list[Path]:
    """The files that a text of a rig names: none where it is a word."""
    try:
        place = resolve_data(text, folder=rig.parent, source=str(rig), key="")
        if place.is_dir():
            return sorted(file for file in place.iterdir() if file.is_file())
        return [place] if place.is_file() else sorted(f for f in place.parent.glob(place.name) if f.is_file())
    except (RigError, OSError, ValueError):
        return []


def _is_file(place: Path) -> bool:
    """Whether a path is that of a file; one that no file can have is not."""
    try:
        return place.is_file()
    except (OSError, ValueError):
        return False


def _named_paths(section: Section, source: Path, *, rigs: bool) -> dict[str, Path]:
    """The files that a table names; rigs that come along may be called by name."""
    found = {}
    for name in section.table:
        text = section.text(name)
        place = Path(os.path.normpath(source.parent.absolute() / text))
        if _is_file(place):
            found[name] = place
        elif rigs and "/" not in text and not text.endswith(".toml"):
            try:
                found[name] = find_rig(text)
            except RigError as error:
                raise section.error(name, str(error)) from None
        else:
            raise section.error(name, f"{place} is not there; relative paths start at the study's folder")
    return found


def _flat(section: Section, above: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and their values, whether written with dots or as tables."""
    for key, value in section.table.items():
        dotted = f"{above}.{key}" if above else key
        if isinstance(value, Mapping):
            yield from _flat(Section(value, section.source, section.dotted(key)), dotted)
        else:
            yield dotted, value


def _subjects(section: Section, source: Path) -> list[dict[str, str]]:
    """One row per subject: of the table, of the folders, or of both where their subjects are the same."""
    section.refuse_unknown(("table", "folders"))
    base = source.parent.absolute()
    rows = _table(section, base) if "table" in section else None
    if "folders" in section:
        pattern = section.text("folders")
        try:
            places = sorted(place for place in base.glob(pattern) if place.is_dir())
        except (NotImplementedError, ValueError) as error:
            raise section.error("folders", f"found {pattern!r}: {error}; write a pattern like data/sub-*") from None
        if not places:
            raise section.error("folders", f"no folder fits {pattern!r} from {base}; correct the pattern")
        by_name = {place.name: place for place in places}
        if len(by_name) < len(places):
            raise section.error("folders", "fits two folders of one name; subjects need names of their own")
        if rows is None:
            rows = [{SUBJECT: name} for name in by_name]
        _require_same(section, [row[SUBJECT] for row in rows], list(by_name))
        rows = [{**row, "folder": str(by_name[row[SUBJECT]])} for row in rows]
    if rows is None:
        raise section.error("table", "is missing, and so is folders; name a CSV of subjects, or a pattern of folders")
    return rows


def _require_same(section: Section, told: list[str], there: list[str]) -> None:
    for name in told:
        if name not in there:
            raise section.error("table", f"subject {name!r} has no folder; take its row out, or add the folder")
    for name in there:
        if name not in told:
            raise section.error("folders", f"{name!r} has no row in the table; add it, or narrow the pattern")


def _table(section: Section, base: Path) -> list[dict[str, str]]:
    path = Path(os.path.normpath(base / section.text("table")))
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise section.error("table", f"{path} cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise section.error("table", f"{path} is not UTF-8 text (byte {error.start}); save it as UTF-8") from None
    first = (text.lstrip().splitlines() or [""])[0]
    lines = csv_lines(text, path, delimiter=max(",;\t", key=first.count))
    if len(lines) < 2:
        raise section.error("table", f"{path} has no row of a subject below its headings; add one")
    headings = [cell.strip() for cell in lines[0][1]]
    headings = [SUBJECT if heading == _BIDS_SUBJECT and SUBJECT not in headings else heading for heading in headings]
    for heading in headings:
        if not heading or headings.count(heading) > 1:
            raise section.error("table", f"{path}: found the heading {heading!r}; expected names, each once")
    if SUBJECT not in headings:
        raise section.error("table", f"{path}: no column {SUBJECT} or {_BIDS_SUBJECT}; found {', '.join(headings)}")
    rows, seen = [], set()
    for line, cells in lines[1:]:
        if len(cells) != len(headings):
            raise section.error("table", f"{path}: line {line} has {len(cells)} cells for {len(headings)} headings")
        row = dict(zip(headings, (cell.strip() for cell in cells), strict=True))
        name = row[SUBJECT]
        if not name or (name in seen and not {RIG, MOTION} & row.keys()):
            said = "no subject" if not name else f"{name!r} a second time"
            raise section.error("table", f"{path}: line {line} has {said}; give each subject a name of its own")
        seen.add(name)
        rows.append(row)
    return rows


def _cases(
    rows: list[dict[str, str]],
    rigs: Mapping[str, Path],
    motions: Mapping[str, Path],
    templates: Mapping[str, Any],
    source: Path,
) -> Iterator[Case]:
    safe = file_names(list(dict.fromkeys(row[SUBJECT] for row in rows)))
    pairs = [(rig, motion) for rig in rigs for motion in (list(motions) or [""])]
    safe_pairs = dict(zip(pairs, file_names(["-".join(filter(None, pair)) for pair in pairs]).values(), strict=True))
    taken: set[str] = set()
    for row in rows:
        for column, known in ((RIG, rigs), (MOTION, motions)):
            if row.get(column, "") and row[column] not in known:
                raise RigError(
                    f"{source}: subjects.table: subject {row[SUBJECT]!r}: {column} is {row[column]!r}; "
                    f"{suggestion(row[column], known)}"
                )
        overrides = tuple(_overrides(row, templates, source))
        facts = {key: cell for key, cell in row.items() if key not in (SUBJECT, RIG, MOTION, "folder")}
        for rig, motion in pairs:
            if row.get(RIG, "") not in ("", rig) or row.get(MOTION, "") not in ("", motion):
                continue
            name = f"{safe[row[SUBJECT]]}/{safe_pairs[rig, motion]}"
            if name in taken:
                raise RigError(f"{source}: subjects.table: {row[SUBJECT]!r} has {rig!r} {motion!r} twice; remove a row")
            taken.add(name)
            yield Case(name, row[SUBJECT], rig, motion, rigs[rig], motions.get(motion), overrides, facts)


def _overrides(row: Mapping[str, str], templates: Mapping[str, Any], source: Path) -> Iterator[str]:
    """What a subject sets: the study's templates with its values, then the columns of its row that are rig keys."""
    values = {**row, "study": str(source.parent.absolute())}
    for key, template in templates.items():
        yield f"{key}={_filled(template, values, where=f'{source}: set.{key}')}"
    for column, cell in row.items():
        if "." in column and cell:
            yield f"{column}={_cell(cell)}"


def _filled(template: Any, values: Mapping[str, str], *, where: str) -> str:
    """A template as TOML: a text that is one placeholder takes the value's own type."""

    def value(match: re.Match[str]) -> str:
        if match[1] not in values:
            raise RigError(f"{where}: no column {match[1]!r} for {{{match[1]}}}; {suggestion(match[1], values)}")
        return values[match[1]]

    if isinstance(template, str):
        filled = _PLACEHOLDER.sub(value, template)
        return _cell(filled) if _PLACEHOLDER.fullmatch(template) else toml_string(filled)
    if isinstance(template, bool):
        return str(template).lower()
    if isinstance(template, list):
        return f"[{', '.join(_filled(item, values, where=where) for item in template)}]"
    return repr(template)


def _cell(cell: str) -> str:
    """A cell of a table as TOML: a number, true or false as such, a list as it stands, the rest as text."""
    if cell in ("true", "false") or cell.startswith("["):
        return cell
    try:
        float(cell)
    except ValueError:
        return toml_string(cell)
    return cell
