"""The commands: each calls one workflow and prints what it gives; exit code 0 passed, 1 a limit failed, 2 bad input.

What else goes wrong ends as exit code 3, in `musclefit.cli.unforeseen`.
"""

from __future__ import annotations

import json as json_text
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import App, CycloptsError, Parameter
from rich.console import Console

from musclefit._version import __version__
from musclefit.anatomy.model import TissueKind
from musclefit.cli.architecture import architecture
from musclefit.cli.batch import batch
from musclefit.cli.cage import cage
from musclefit.cli.check_mesh import check_mesh
from musclefit.cli.collect import collect
from musclefit.cli.compare import compare
from musclefit.cli.export import export
from musclefit.cli.export_motion import export_motion
from musclefit.cli.export_osim import export_osim
from musclefit.cli.febio_model import febio_model
from musclefit.cli.fit_body import fit_body
from musclefit.cli.fit_joint import fit_joint
from musclefit.cli.from_labels import from_labels
from musclefit.cli.import_osim import import_osim
from musclefit.cli.joint_range import joint_range
from musclefit.cli.kinds import parse_kinds
from musclefit.cli.label_surfaces import label_surfaces
from musclefit.cli.logs import HELP, IN_FILE, log_options, logging_to
from musclefit.cli.options import QuietOption, print_json
from musclefit.cli.render import render
from musclefit.cli.repair import repair
from musclefit.cli.rigs import init, rigs, schema
from musclefit.cli.sequence import sequence
from musclefit.cli.view import view
from musclefit.cli.warp_deck import warp_deck
from musclefit.cli.warp_field import warp_field
from musclefit.cli.warp_image import warp_image
from musclefit.errors import MusclefitError
from musclefit.io.rig_names import builtin_rigs, find_rig
from musclefit.vocabulary import BackendKind
from musclefit.workflows.progress import LOG, TimedStages

# The commands import what reads and computes when they need it, so that mistakes are told at once.

PASSED, FAILED, BAD_INPUT, PIPE_CLOSED = 0, 1, 2, 141

DEMO_RIG = "upper_limb"

app = App(
    name="musclefit",
    help="Foldover-free retargeting of layered musculoskeletal models, with a report that proves it.",
    version=__version__,
    help_epilogue="Exit code 0: passed; 1: a limit is exceeded, the report is written; 2: bad input, nothing is "
    f"written; 3: unexpected error, a log file is written; 130: interrupted. {HELP}",
    default_parameter=Parameter(negative=(), show_default=False),
    usage="Usage: musclefit COMMAND [OPTIONS]",
    suppress_keyboard_interrupt=False,
)

Json = Annotated[bool, Parameter(name="--json", help="Print report.json instead of a summary.")]
NoPictures = Annotated[bool, Parameter(name="--no-pictures", help="Draw no pictures, which saves seconds.")]
Tets = Annotated[
    bool | None,
    Parameter(
        name="--tets",
        negative="--no-tets",
        help="Make tetrahedra of all tissues together and prove the deformed mesh, which takes minutes; or make none, "
        "whatever the rig says.",
    ),
]


@app.command(sort_key=1)
def demo(
    *,
    out: Annotated[
        Path,
        Parameter(name="--out", help="Folder for the results; a former run there is replaced.", show_default=True),
    ] = Path("musclefit-out/demo"),
    tets: Tets = None,
    no_pictures: NoPictures = False,
    quiet: QuietOption = False,
    json: Json = False,
) -> int:
    """Bend the built-in upper limb (elbow 75 degrees, forearm 70 degrees) and prove the result."""
    return _run(find_rig(DEMO_RIG), (), out=out, tets=tets, pictures=not no_pictures, quiet=quiet, json=json)


@app.command(sort_key=2)
def run(
    rig: Annotated[str, Parameter(help=f"A rig file, or the name of a built-in rig: {', '.join(builtin_rigs())}.")],
    /,
    *,
    out: Annotated[
        Path | None,
        Parameter(
            name="--out",
            help="Folder for the results; a former run there is replaced. Without it: musclefit-out/ and the rig's "
            "name.",
        ),
    ] = None,
    backend: Annotated[
        str,
        Parameter(
            name="--backend",
            help=f"Interpolation of displacements: {', '.join(BackendKind)}; the same as --set deformer.backend=...",
        ),
    ] = "",
    set: Annotated[  # noqa: A002 (the option's name)
        tuple[str, ...],
        Parameter(
            name="--set",
            help="key=value: replace one value of the rig file, such as deformer.kernel=r3. May be repeated.",
        ),
    ] = (),
    points: Annotated[
        tuple[Path, ...],
        Parameter(
            name="--points",
            help="A file of attached points to deform too (CSV, .fcsv, .mrk.json, .trc, .ply, .stl, .obj, .vtp, .vtu), "
            "written to points/ in the same format. May be repeated.",
        ),
    ] = (),
    intermediate: Annotated[
        bool,
        Parameter(name="--intermediate", help="Also write the surfaces after each step, to intermediate/01, ..."),
    ] = False,
    tets: Tets = None,
    no_pictures: NoPictures = False,
    quiet: QuietOption = False,
    json: Json = False,
) -> int:
    """Run a rig: deform its anatomy, check the result, and write surfaces, tetrahedra and a report."""
    path = find_rig(rig)
    overrides = (*set, *([f"deformer.backend={backend}"] if backend else []))
    folder = out if out is not None else Path("musclefit-out") / path.stem
    return _run(
        path,
        overrides,
        out=folder,
        points=points,
        tets=tets,
        intermediate=intermediate,
        pictures=not no_pictures,
        quiet=quiet,
        json=json,
    )


@app.command(sort_key=3)
def check(
    paths: Annotated[
        list[Path], Parameter(help="A folder of closed surfaces, or the files: PLY, STL, OBJ, VTP; one per tissue.")
    ],
    /,
    *,
    out: Annotated[
        Path | None,
        Parameter(
            name="--out",
            help="Folder for the report; a former one there is replaced. Without it, the report is only printed.",
        ),
    ] = None,
    units: Annotated[
        Literal["mm", "cm", "m"], Parameter(name="--units", help="Length unit of the files.", show_default=True)
    ] = "mm",
    kind: Annotated[
        tuple[str, ...],
        Parameter(
            name="--kind",
            help="name=kind: what a tissue is, overriding its file name; the name may be a pattern, the kind "
            f"is {', '.join(TissueKind)}. May be repeated.",
        ),
    ] = (),
    fail_on: Annotated[
        tuple[str, ...],
        Parameter(
            name="--fail-on",
            help="Findings that also fail the check (exit code 1), separated by commas, such as "
            "self-crossing,non-manifold,pieces; overlaps, open surfaces and surfaces without an inside always fail it.",
        ),
    ] = (),
    thinnest_mm: Annotated[
        float,
        Parameter(
            name="--thinnest-mm",
            help="Fail where a wall of a tissue is thinner, or a slot narrower, than this; 0: not checked.",
        ),
    ] = 0.0,
    smallest_gap_mm: Annotated[
        float,
        Parameter(
            name="--smallest-gap-mm",
            help="Fail where two tissues that do not overlap are closer than this; 0: not checked.",
        ),
    ] = 0.0,
    quiet: QuietOption = False,
    json: Json = False,
) -> int:
    """Report the overlaps and mesh faults of a layered anatomy as it stands."""
    from musclefit.report.schema import to_json
    from musclefit.workflows.check import check as examine

    with TimedStages(shown=not quiet) as stages:
        kinds = parse_kinds(kind)
        codes = [code.strip() for codes in fail_on for code in codes.split(",") if code.strip()]
        report = examine(
            paths,
            out=out,
            units=units,
            kinds=kinds,
            fail_on=codes,
            thinnest_mm=thinnest_mm,
            smallest_gap_mm=smallest_gap_mm,
            progress=stages,
        ).report
    if json:
        print_json(to_json(report) if out is None else _written(out))
    elif not quiet:
        from musclefit.cli.summary import print_inspection

        print_inspection(report, folder=out)
    return PASSED if report.verdict == "passed" else FAILED


app.command(warp_image, name="warp-image", sort_key=4)
app.command(warp_field, name="warp-field", sort_key=4)
app.command(warp_deck, name="warp-deck", sort_key=4)
app.command(export_osim, name="export-osim", sort_key=5)
app.command(import_osim, name="import-osim", sort_key=5)
app.command(label_surfaces, name="label-surfaces", sort_key=5)
app.command(from_labels, name="from-labels", sort_key=5)
app.command(export, sort_key=5)
app.command(export_motion, name="export-motion", sort_key=5)
app.command(check_mesh, name="check-mesh", sort_key=5)
app.command(sequence, name="sequence", sort_key=6)
app.command(fit_joint, name="fit-joint", sort_key=7)
app.command(joint_range, name="joint-range", sort_key=7)
app.command(architecture, sort_key=7)
app.command(febio_model, name="febio-model", sort_key=7)
app.command(repair, sort_key=3)
app.command(fit_body, name="fit-body", sort_key=4)
app.command(cage, sort_key=6)
app.command(batch, sort_key=6)
app.command(collect, sort_key=6)
app.command(compare, sort_key=3)
app.command(view, sort_key=3)
app.command(render, sort_key=3)
app.command(rigs, sort_key=8)
app.command(init, sort_key=8)
app.command(schema, sort_key=8)
app.register_install_completion_command(sort_key=9)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and give the exit code.

    Parameters
    ----------
    arguments : sequence of str, or None for those of the process
    """
    for stream in (sys.stdout, sys.stderr):
        with suppress(AttributeError):  # names that the terminal cannot show must not end a run
            stream.reconfigure(errors="backslashreplace")  # type: ignore[union-attr]
    try:
        asked = log_options(sys.argv[1:] if arguments is None else arguments)
        with logging_to(asked):
            code = _exit_code(asked.arguments)
            LOG.debug("ended with exit code %d", code, extra=IN_FILE)
            return code
    except MusclefitError as error:
        return _refuse(str(error))


def _exit_code(arguments: Sequence[str]) -> int:
    try:
        result = app(list(arguments), exit_on_error=False, print_error=False, result_action="return_value")
        sys.stdout.flush()
    except CycloptsError as error:
        return _refuse(f"{error} See musclefit --help")
    except MusclefitError as error:
        return _refuse(str(error))
    except BrokenPipeError:  # whoever read our output has had enough, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return PIPE_CLOSED
    except OSError as error:
        where = f" ({error.filename})" if error.filename else ""
        return _refuse(f"{error.strerror or error}{where}; check the path, its permissions and the free space")
    return result if isinstance(result, int) else PASSED


def _run(
    rig: Path,
    overrides: Sequence[str],
    *,
    out: Path,
    points: Sequence[Path] = (),
    tets: bool | None = None,
    intermediate: bool = False,
    pictures: bool = True,
    quiet: bool,
    json: bool,
) -> int:
    from musclefit.workflows.run import run as make

    with TimedStages(shown=not quiet) as stages:
        report = make(
            rig,
            out=out,
            overrides=overrides,
            points=points,
            tets=tets,
            intermediate=intermediate,
            pictures=pictures,
            progress=stages,
        ).report
    if json:
        print_json(_written(out))
    elif not quiet:
        from musclefit.cli.summary import print_run

        print_run(report, folder=out)
    return PASSED if report.verdict == "passed" else FAILED


def _written(folder: Path) -> Any:
    """The report as it was written, with the files beside it."""
    from musclefit.io.run_folder import REPORT_JSON

    return json_text.loads((folder / REPORT_JSON).read_text(encoding="utf-8"))


def _refuse(message: str) -> int:
    LOG.error("%s", message, extra=IN_FILE)
    Console(stderr=True, highlight=False, soft_wrap=True).print(f"musclefit: {message}", markup=False)
    return BAD_INPUT
