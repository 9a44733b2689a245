"""The commands: each reads, calls one pipeline function, writes; exit code 0 passed, 1 a limit failed, 2 bad input."""

from __future__ import annotations

import json as json_text
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console

import musclefit
from musclefit.anatomy.model import TissueKind
from musclefit.cli.progress import TimedStages
from musclefit.cli.summary import print_inspection, print_run
from musclefit.errors import InputError, MusclefitError
from musclefit.io.outputs import check_writable, write_inspection
from musclefit.io.provenance import measured
from musclefit.io.rigs import builtin_rigs, find_rig, read_rig
from musclefit.io.runs import prepared_tets, save
from musclefit.io.surfaces import read_anatomy
from musclefit.pipeline.inspect import inspect
from musclefit.pipeline.retarget import retarget
from musclefit.report.schema import to_json
from musclefit.rig.model import Unit

PASSED, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130

DEMO_RIG = "upper_limb"

app = App(
    name="musclefit",
    help="Foldover-free retargeting of layered musculoskeletal models, with a report that proves it.",
    version=musclefit.__version__,
    help_epilogue=f"Built-in rigs: {', '.join(builtin_rigs())}. "
    "Exit code 0: passed; 1: a limit failed, the report is written; 2: bad input, nothing is written.",
)

Out = Annotated[Path, Parameter(name="--out", help="Folder for the results; a former run there is replaced.")]
Quiet = Annotated[bool, Parameter(name="--quiet", negative="", help="Print nothing but errors.")]
Json = Annotated[bool, Parameter(name="--json", negative="", help="Print the report as JSON instead of a summary.")]
NoTets = Annotated[bool, Parameter(name="--no-tets", negative="", help="Do not tetrahedralise.")]


@app.command
def demo(
    *,
    out: Out = Path("musclefit-out/demo"),
    no_tets: NoTets = False,
    quiet: Quiet = False,
    json: Json = False,
) -> int:
    """Bend the built-in upper limb to elbow 75 degrees, forearm 70 degrees, and prove what was done."""
    return _run(find_rig(DEMO_RIG), (), out=out, no_tets=no_tets, quiet=quiet, json=json)


@app.command
def run(
    rig: Annotated[str, Parameter(help="A rig file, or the name of a built-in rig.")],
    *,
    out: Annotated[
        Path | None, Parameter(name="--out", help="Folder; default: musclefit-out/ and the rig's name.")
    ] = None,
    backend: Annotated[str, Parameter(help="Field backend; the same as --set deformer.backend=...")] = "",
    set: Annotated[  # noqa: A002 (the option's name)
        tuple[str, ...], Parameter(name="--set", help="key=value, as in the rig file; may be given again.")
    ] = (),
    no_tets: NoTets = False,
    quiet: Quiet = False,
    json: Json = False,
) -> int:
    """Run a rig: deform its anatomy, check the result, write surfaces, tetrahedra and report."""
    path = find_rig(rig)
    overrides = (*set, *([f"deformer.backend={backend}"] if backend else []))
    folder = out if out is not None else Path("musclefit-out") / path.stem
    return _run(path, overrides, out=folder, no_tets=no_tets, quiet=quiet, json=json)


@app.command
def check(
    paths: Annotated[list[Path], Parameter(help="A folder of surfaces, or surface files.")],
    *,
    out: Annotated[
        Path | None, Parameter(name="--out", help="Folder for the report; without it, only printed.")
    ] = None,
    units: Annotated[Unit, Parameter(help="Length unit of the files.")] = Unit.MILLIMETRE,
    kind: Annotated[
        tuple[str, ...], Parameter(name="--kind", help="pattern=kind, ahead of what names say; may be given again.")
    ] = (),
    quiet: Quiet = False,
    json: Json = False,
) -> int:
    """Report the overlaps and mesh faults of a layered anatomy as it is."""
    if out is not None:
        check_writable(out)
    with TimedStages(shown=not quiet) as stages:
        source = paths[0] if len(paths) == 1 and paths[0].is_dir() else paths
        read = read_anatomy(source, units=units, kinds=_kinds(kind), progress=stages)
        found = inspect(read.anatomy, findings=read.findings, title=str(paths[0]), progress=stages)
    report = replace(found, **measured(stages.seconds, provenance={"input_sha256": dict(read.hashes)}))
    if out is not None:
        write_inspection(out, report)
    if json:
        print(json_text.dumps(to_json(report), indent=2, allow_nan=False))
    elif not quiet:
        print_inspection(report, folder=out)
    return PASSED if report.verdict == "passed" else FAILED


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give the exit code.

    Parameters
    ----------
    arguments : sequence of str, or None for those of the process
    """
    try:
        result = app(
            list(sys.argv[1:] if arguments is None else arguments),
            exit_on_error=False,
            print_error=False,
            result_action="return_value",
        )
    except (MusclefitError, CycloptsError) as error:
        return _refuse(str(error))
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return _refuse(f"{error.strerror or error}{where}; check the path, its permissions and the free space")
    except KeyboardInterrupt:
        print("musclefit: interrupted; nothing was left half-written", file=sys.stderr)
        return INTERRUPTED
    return result if isinstance(result, int) else PASSED


def _run(rig: Path, overrides: Sequence[str], *, out: Path, no_tets: bool, quiet: bool, json: bool) -> int:
    check_writable(out)
    with TimedStages(shown=not quiet) as stages:
        job = read_rig(rig, overrides=overrides, progress=stages)
        tets = None if no_tets else prepared_tets(job, progress=stages)
        result = retarget(job, tets=tets, progress=stages)
        report = save(result, out, seconds=stages.seconds, progress=stages)
    if json:
        print(json_text.dumps(to_json(report), indent=2, allow_nan=False))
    elif not quiet:
        print_run(report, folder=out)
    return PASSED if report.verdict == "passed" else FAILED


def _kinds(given: Sequence[str]) -> tuple[tuple[str, TissueKind], ...]:
    kinds = []
    for text in given:
        pattern, _, kind = text.partition("=")
        if not pattern or kind not in set(TissueKind):
            raise InputError(f"--kind {text!r}: write pattern=kind with kind one of {', '.join(TissueKind)}")
        kinds.append((pattern, TissueKind(kind)))
    return tuple(kinds)


def _refuse(message: str) -> int:
    Console(stderr=True, highlight=False, soft_wrap=True).print(f"musclefit: {message}", markup=False)
    return BAD_INPUT
