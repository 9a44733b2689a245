"""A report -> a paragraph on methods for a paper, with references, and the command that makes the run again.

Each sentence is there because the run did what it says; what a report does not tell is left out.
"""

from __future__ import annotations

import math
import shlex
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from musclefit.anatomy.model import TissueKind
from musclefit.report.citations import WORKS, Work
from musclefit.report.model import CONVERGED, Report
from musclefit.vocabulary import BackendKind, Claim, StepKind

_LIBRARIES = {
    "numpy": ("NumPy", "harris2020array"),
    "scipy": ("SciPy", "virtanen2020scipy"),
    "numba": ("Numba", "lam2015numba"),
}
_VERSION_OF = {
    "musclefit": "musclefit",
    "manifold": "manifold3d",
    "harris2020array": "numpy",
    "virtanen2020scipy": "scipy",
    "lam2015numba": "numba",
    "sullivan2019pyvista": "pyvista",
    "hu2020fast": "pytetwild",
}
"""The library whose version a reference is cited with."""

LEAST_MM = 1e-9
"""Below that, how far a landmark is off, or a bone, is rounding."""

_TOLD = {
    "landmark error": "every landmark arrived within {}",
    "bone off rigid": "no bone departed from its rigid motion by more than {}",
    "muscle volume change": "no muscle changed its volume by more than {}",
    "introduced overlap": "the overlap between tissues that the deformation introduced was {} in all",
    "inverted tets": "{} were inverted",
}
"""Checks that a paragraph on methods names, and how."""


@dataclass(frozen=True, slots=True)
class Methods:
    """How a run was made, for a paper.

    Parameters
    ----------
    paragraph : str
        With numbers in square brackets for the references.
    references : tuple of str
        In the order of their numbers.
    bibtex : str
    command : str
        That makes the run again, from the rig; "" where the rig was no file.
    remarks : tuple of str
        What the command does not fix.
    versions, inputs : mapping of str to str
        Versions of what computed, and SHA-256 of the input by file name.
    """

    paragraph: str
    references: tuple[str, ...]
    bibtex: str
    command: str
    remarks: tuple[str, ...]
    versions: Mapping[str, str]
    inputs: Mapping[str, str]


@dataclass(slots=True)
class _References:
    """Works in the order in which they are first cited."""

    works: list[Work] = field(default_factory=list)

    def to(self, *keys: str) -> str:
        """The numbers of works in square brackets."""
        numbers = []
        for key in keys:
            work = WORKS[key]
            if work not in self.works:
                self.works.append(work)
            numbers.append(str(self.works.index(work) + 1))
        return f"[{', '.join(numbers)}]"


def methods_of(report: Report, *, pictures: bool) -> Methods:
    """The methods of a run.

    Parameters
    ----------
    report : Report
    pictures : bool
        Whether pictures were drawn.
    """
    provenance = report.provenance
    settings: Mapping[str, Any] = provenance.get("settings", {})
    versions = {name: str(version) for name, version in provenance.get("versions", {}).items()}
    references = _References()
    sentences = [
        _anatomy(report, versions, references),
        _handles(report, settings),
        _field(settings, references),
        _bones(settings),
        _steps(report, settings, references),
        _map(report),
        _mesh(report, references),
        _checks(report, references),
        _comparison(report, references),
        _software(versions, references, pictures=pictures),
    ]
    return Methods(
        paragraph=" ".join(filter(None, sentences)),
        references=tuple(work.words for work in references.works),
        bibtex="\n\n".join(work.bibtex(version=_version(work, versions)) for work in references.works),
        command=_command(settings, provenance.get("input_sha256", {})),
        remarks=_remarks(report, settings),
        versions=versions,
        inputs={str(name): str(digest) for name, digest in provenance.get("input_sha256", {}).items()},
    )


def _version(work: Work, versions: Mapping[str, str]) -> str:
    """The library that stands for a work and its version; "" where the run does not tell."""
    library = _VERSION_OF.get(work.key, "")
    return f"{library} {versions[library]}" if library in versions else ""


def methods_text(methods: Methods) -> str:
    """The methods as Markdown: paragraph, references, BibTeX, command and hashes."""
    numbered = [f"{number}. {words}" for number, words in enumerate(methods.references, start=1)]
    again = ["```sh", methods.command, "```"] if methods.command else ["The rig was given in Python; see report.json."]
    remarks = [f"- {remark}" for remark in methods.remarks]
    hashes = [f"- `{name}` {digest}" for name, digest in methods.inputs.items()]
    versions = ", ".join(f"{name} {version}" for name, version in methods.versions.items())
    parts = [
        ["## Methods", "", methods.paragraph],
        ["## References", "", *numbered],
        ["## BibTeX", "", "```bibtex", methods.bibtex, "```"],
        ["## To make it again", "", *again, "", *remarks],
        ["## Versions and SHA-256 of the input", "", versions, "", *hashes],
    ]
    return "\n\n".join("\n".join(part) for part in parts) + "\n"


def _anatomy(report: Report, versions: Mapping[str, str], references: _References) -> str:
    counts = Counter(tissue.kind for tissue in report.result.tissues)
    named = ((TissueKind.BONE, "bone"), (TissueKind.MUSCLE, "muscle"), (TissueKind.OTHER, "other tissue"))
    parts = [f"{counts[kind]} {word}{'' if counts[kind] == 1 else 's'}" for kind, word in named if counts[kind]]
    parts += ["the skin"] if counts[TissueKind.SKIN] else []
    program = f"musclefit {versions['musclefit']}" if "musclefit" in versions else "musclefit"
    return (
        f"An anatomy of {_joined(parts)} was deformed with {program} {references.to('musclefit')}, after the "
        f"foldover-free deformation of Yu et al. {references.to('yu2014foldover')}."
    )


def _handles(report: Report, settings: Mapping[str, Any]) -> str:
    drive = settings.get("drive", {})
    count = report.result.landmarks.count
    pose = drive.get("pose") if "joints" in drive else None
    if pose:
        angles = _joined([f"{name} {float(degrees):g}°" for name, degrees in _pairs(pose)])
        return f"Its joints were set to {angles}, and moved {count} landmarks on the bones."
    return f"It was driven by {count} handles whose destinations were given." if count else ""


def _field(settings: Mapping[str, Any], references: _References) -> str:
    deformer = settings.get("deformer", {})
    backend, kernel = str(deformer.get("backend", "")), str(deformer.get("kernel", ""))
    if backend in (BackendKind.FFD, BackendKind.LATTICE):
        free = ", whose fields are divergence-free" if settings.get("bones", {}).get("rigid") else ""
        return (
            "Their displacements were carried to all other places by free-form deformations with cubic B-splines "
            f"{references.to('sederberg1986free')}{free}."
        )
    if not kernel:
        return ""
    levels = ", refined by compact levels" if backend == BackendKind.MULTILEVEL else ""
    if kernel.startswith("isochoric"):
        cited = references.to("narcowich1994generalized")
        return (
            "Their displacements were interpolated by a divergence-free field of matrix-valued radial functions "
            f"(kernel {kernel}{levels}) {cited}, whose flow keeps volume."
        )
    more = {"r2logr": ("bookstein1989principal",)}.get(kernel, ())
    more = ("wendland1995piecewise",) if kernel.startswith("wendland") else more
    cited = f" {references.to(*more)}" if more else ""
    return (
        f"Their displacements were interpolated by radial basis functions (kernel {kernel}{levels}) with an affine "
        f"part{cited}."
    )


def _bones(settings: Mapping[str, Any]) -> str:
    bones = settings.get("bones", {})
    if bones.get("rigid"):
        locked = ", and smooth weights blend it into each bone's own motion at its surface" if bones.get("lock") else ""
        return (
            "Bones moved rigidly; a divergence-free field of B-spline vector potentials, fitted to their motions on "
            f"nested lattices, brings soft tissue along with them{locked}."
        )
    if bones.get("keep_rigid") or bones.get("keep_similar"):
        return "The bones that the rig names kept their shape up to a rigid motion or a uniform scale."
    return ""


def _steps(report: Report, settings: Mapping[str, Any], references: _References) -> str:
    side = report.result
    step = str(settings.get("deformer", {}).get("step", ""))
    if not step:
        return ""
    count = f"{side.steps} step{'' if side.steps == 1 else 's'}"
    if step == StepKind.CAYLEY:
        how = (
            f"The displacements were applied in {count} of the implicit midpoint rule, short enough to keep the "
            f"condition for a one-to-one step ({side.map.rule})"
        )
    else:
        how = (
            f"The displacements were applied in {count}, short enough to keep the condition for a one-to-one step "
            f"({side.map.rule}) {references.to('yu2014foldover')}"
        )
    ended = "" if side.status == CONVERGED else f"; the landmarks did not all arrive ({side.status})"
    return f"{how}{ended}."


def _map(report: Report) -> str:
    found = report.result.map
    points = f"{found.points_tested:,} points".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return {
        Claim.CERTIFIED: "Each step was proved one-to-one on a domain that contains the body, by branch and bound over "
        "boxes, rounding included.",
        Claim.SAMPLED: f"The condition was tested at {points}; between them nothing was proved.",
        Claim.UNDECIDED: f"The condition was tested at {points}; a proof between them was tried and did not come to an "
        "end.",
        Claim.REFUTED: "The map folds: a place was proved at which it is not one-to-one.",
    }[found.claim]


def _mesh(report: Report, references: _References) -> str:
    found = report.result.mesh
    if found is None:
        return ""
    made = (
        f"All tissues were tetrahedralised together ({found.tets} tetrahedra moved) by fTetWild "
        f"{references.to('hu2020fast')}"
    )
    if found.claim is Claim.CERTIFIED:
        return (
            f"{made}; all deformed tetrahedra were proved positively oriented by exact predicates "
            f"{references.to('shewchuk1997adaptive')} and their boundary free of intersections, so that no two tissues "
            "of the mesh intersect."
        )
    ended = "refuted, because some are inverted or cross" if found.claim is Claim.REFUTED else "not decided"
    return f"{made}; that the deformed tetrahedra share no volume was {ended}."


def _checks(report: Report, references: _References) -> str:
    by_name = {check.name: check for check in report.checks}
    told = [
        words.format(f"{max(check.value, LEAST_MM) if check.unit == 'mm' else check.value:.3g} {check.unit}".strip())
        for name, words in _TOLD.items()
        if (check := by_name.get(name)) is not None and not math.isnan(check.value)
    ]
    broken = [check.name for check in report.checks if not check.passed]
    verdict = f"These limits were broken: {', '.join(broken)}." if broken else "All limits were kept."
    solids = f"Overlaps were measured as volumes of intersections of solids {references.to('manifold')}."
    return f"{solids} {_sentence(_joined(told))} {verdict}" if told else f"{solids} {verdict}"


def _comparison(report: Report, references: _References) -> str:
    beside = [f"one step held to no rule ({report.baseline.method})"] if report.baseline is not None else []
    if report.paper_loop is not None:
        beside.append(f"the published loop {references.to('yu2014foldover')}")
    return f"For comparison, the same landmarks were given to {_joined(beside)}." if beside else ""


def _software(versions: Mapping[str, str], references: _References, *, pictures: bool) -> str:
    used = [f"Python {versions['python']}"] if "python" in versions else []
    used += [
        f"{name} {versions[key]} {references.to(cited)}" for key, (name, cited) in _LIBRARIES.items() if key in versions
    ]
    if pictures and "pyvista" in versions:
        used.append(f"PyVista {versions['pyvista']} {references.to('sullivan2019pyvista')} for pictures")
    return f"Computed with {_joined(used)}." if used else ""


def _command(settings: Mapping[str, Any], hashes: Mapping[str, Any]) -> str:
    """The command line; "" where no rig file is among the input."""
    rig = str(settings.get("rig", ""))
    if f"{rig}.toml" not in hashes:
        return ""
    name = rig if settings.get("anatomy", {}).get("builtin") else f"{rig}.toml"
    words = ["musclefit", "run", name]
    for override in settings.get("overrides", ()):
        words += ["--set", str(override)]
    return shlex.join(words)


def _remarks(report: Report, settings: Mapping[str, Any]) -> tuple[str, ...]:
    remarks = ["The same numbers are to be expected of the same versions on the same kind of processor"]
    if not settings.get("anatomy", {}).get("builtin"):
        remarks.append("Rig and anatomy must be the files of the hashes below, where the rig looks for them")
    if report.result.mesh is not None:
        remarks.append("Another call of fTetWild makes another mesh, unless the mesh is in the cache")
    return tuple(remarks)


def _pairs(pose: Any) -> list[tuple[str, float]]:
    """Coordinates and degrees, of a mapping or of pairs."""
    return list(pose.items()) if isinstance(pose, Mapping) else [(str(name), value) for name, value in pose]


def _joined(parts: list[str]) -> str:
    return ", ".join(parts[:-1]) + (" and " if len(parts) > 1 else "") + parts[-1] if parts else ""


def _sentence(words: str) -> str:
    return f"{words[0].upper()}{words[1:]}." if words else ""
