"""RBF and FFD on a real forearm by 35 landmarks: the same loop, the same landmarks, the same certificates.

    MUSCLEFIT_DATA=... python examples/forearm_backends.py

Elbow 75 degrees, forearm 70 degrees; bones are not held rigid, so that the backends alone are compared.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from musclefit.anatomy.model import Anatomy, TissueKind
from musclefit.certify.maps import certify_map
from musclefit.fields.protocol import Field
from musclefit.flow.deformation import Deformation
from musclefit.flow.steps import CayleyStep
from musclefit.geometry.measures import enclosed_volume
from musclefit.io.rig_names import find_rig
from musclefit.io.rigs import read_rig
from musclefit.pipeline.deformers import deform
from musclefit.progress import Silent
from musclefit.validate.overlaps import check_overlaps, solid_anatomy
from musclefit.vocabulary import StepKind

CAYLEY = ("deformer.step=cayley", "deformer.path=joints")

METHODS = {
    "RBF r, explicit": ("deformer.kernel=r",),
    "RBF r^2 log r, explicit": ("deformer.kernel=r2logr",),
    "FFD 20 mm, explicit": ("deformer.backend=ffd",),
    "RBF r^2 log r, Cayley, joint paths": ("deformer.kernel=r2logr", *CAYLEY),
    "RBF isochoric r^3, Cayley, joint paths": ("deformer.kernel=isochoric-r3", *CAYLEY),
    "FFD 20 mm, Cayley, joint paths": ("deformer.backend=ffd", *CAYLEY),
}
"""Settings of each method over the rig's."""


def volume_changes(rest: Anatomy, deformed: Anatomy) -> np.ndarray:
    """Change of each muscle's volume, percent."""
    return np.array(
        [
            100.0 * (enclosed_volume(deformed[t.name].surface) / enclosed_volume(t.surface) - 1.0)
            for t in rest.of_kind(TissueKind.MUSCLE)
        ]
    )


def steps_of(deformation: Deformation) -> list[tuple[StepKind, Field]]:
    """Kinds and fields, as the certificate takes them."""
    return [
        (StepKind.CAYLEY if isinstance(step, CayleyStep) else StepKind.EXPLICIT, step.field)
        for step in deformation.steps
    ]


def row(method: str, overrides: tuple[str, ...], *, certify: bool, overlaps: bool) -> str:
    """One line of the table."""
    job = read_rig(find_rig("forearm"), overrides=("bones.rigid=false", *overrides))
    points = job.anatomy.vertices()
    deform(job, points[::50], progress=Silent())  # compiles
    start = time.process_time()
    deformation = deform(job, points, progress=Silent()).deformation
    seconds = time.process_time() - start
    deformed = job.anatomy.with_vertices(deformation(points))
    changes = volume_changes(job.anatomy, deformed)
    claim = "not tried"
    if certify:
        start = time.process_time()
        skin = job.anatomy.skin
        proof = certify_map(steps_of(deformation), skin.surface if skin is not None else points)
        claim = f"{proof.claim.value}, {time.process_time() - start:.0f} s"
    introduced = "not measured"
    if overlaps:
        found = check_overlaps(
            solid_anatomy(job.anatomy, progress=Silent()), deformed, mapped=deformation.with_jacobian, progress=Silent()
        )
        introduced = f"{sum(pair.introduced_mm3 for pair in found.pairs):.2f} in {len(found.pairs)}"
    missed = np.abs(deformation(job.handles.source) - job.path.position(1.0)).max()
    folded = int((~(np.linalg.det(deformation.jacobian(points)) > 0.0)).sum())
    cells = (
        method,
        deformation.status.name.lower(),
        len(deformation.steps),
        f"{np.median(np.abs(changes)):.2f}",
        f"{changes[np.argmax(np.abs(changes))]:+.1f}",
        introduced,
        folded,
        f"{missed:.1e}",
        claim,
        f"{seconds:.1f}",
    )
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--no-certificate", action="store_true")
    parser.add_argument("--no-overlaps", action="store_true")
    options = parser.parse_args()
    print(
        "| method | ended | steps | muscle volume, median of abs, % | worst, % | introduced overlap, mm³, in pairs | "
        "folded vertices | landmarks, mm | map | CPU of the loop, s |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    for method, overrides in METHODS.items():
        line = row(method, overrides, certify=not options.no_certificate, overlaps=not options.no_overlaps)
        print(line, flush=True)


if __name__ == "__main__":
    main()
