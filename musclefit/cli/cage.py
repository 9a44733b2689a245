"""The command that makes a cage of a skin."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.errors import InputError
from musclefit.vocabulary import Unit

PASSED = 0


def cage(
    skin: Annotated[Path, Parameter(help="The closed surface to follow: PLY, STL, OBJ, VTP.")],
    out: Annotated[Path, Parameter(help="The cage to write: PLY, in mm.")],
    /,
    *,
    vertices: Annotated[
        int, Parameter(name="--vertices", help="How many vertices the cage shall have.", show_default=True)
    ] = 500,
    units: Annotated[
        Literal["mm", "cm", "m"], Parameter(name="--units", help="Length unit of the skin's file.", show_default=True)
    ] = "mm",
    quiet: Annotated[bool, Parameter(name="--quiet", negative="", help="Print nothing but errors.")] = False,
) -> int:
    """Make a cage that follows a skin: even triangles, none of which cross. Move its vertices, and it drives a body."""
    import numpy as np

    from musclefit.anatomy.cleaning import take_in
    from musclefit.anatomy.model import TissueKind
    from musclefit.geometry.measures import enclosed_volume
    from musclefit.geometry.queries.distances import nearest_places
    from musclefit.geometry.surfaces.cages import cage_of
    from musclefit.geometry.surfaces.topology import edges_of
    from musclefit.io.anatomy import read_surface
    from musclefit.io.run_folder import ply_bytes

    if out.suffix.lower() != ".ply":
        raise InputError(f"{out}: cages are written as PLY; name a file that ends in .ply")
    raw = read_surface(skin, units=Unit(units))
    tissue, findings = take_in(skin.stem, TissueKind.SKIN, vertices=raw.vertices, faces=raw.faces, source=str(skin))
    surface = tissue.surface
    made = cage_of(surface, vertices=vertices)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_bytes(ply_bytes(made))
    if not quiet:
        for finding in findings:
            print(finding.message, file=sys.stderr)
        a, b = edges_of(made.faces).ends.T
        short, middle, long = np.percentile(np.linalg.norm(made.vertices[a] - made.vertices[b], axis=1), [5, 50, 95])
        off = nearest_places(surface.vertices, made).distances
        print(
            f"wrote {out}: {len(made.vertices)} vertices, {len(made.faces)} triangles, closed, none cross; edges "
            f"{middle:.3g} mm (5 to 95 %: {short:.3g} to {long:.3g}); the skin is {off.mean():.2g} mm from it on "
            f"average, {off.max():.3g} mm at most; volume {enclosed_volume(made):.6g} mm³, the skin's "
            f"{enclosed_volume(surface):.6g}"
        )
    return PASSED
