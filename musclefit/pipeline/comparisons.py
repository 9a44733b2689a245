"""What a result is shown beside: the paper's loop on the same handles, as a job of its own that costs little."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from musclefit.fields.kernels import KERNELS
from musclefit.progress import MARCH, Progress, Tick
from musclefit.rig.handles import StraightPath
from musclefit.rig.job import Job
from musclefit.rig.settings import BoneSettings, CertificateSettings, DeformerSettings
from musclefit.vocabulary import BackendKind, Compared, PathKind, StepKind, StepRule

LOOP_MARCH = "march the paper's loop"


def is_papers_loop(job: Job) -> bool:
    """Whether the job's own method is the loop of Yu et al. 2014, by radial sums or free-form deformation.

    That is: explicit steps held to their row-norm rule on straight lines (through keyframes, if there are any), by a
    field that keeps neither volumes nor bones.
    """
    settings, bones = job.rig.deformer, job.rig.bones
    return (
        settings.step is StepKind.EXPLICIT
        and settings.step_rule is StepRule.ROW_NORM
        and settings.path is PathKind.STRAIGHT
        and not (settings.backend is BackendKind.RBF and KERNELS[settings.kernel].isochoric)
        and not (bones.rigid or bones.keep_rigid or bones.keep_similar)
    )


def papers_loop(job: Job) -> Job | None:
    """The loop of Yu et al. 2014 on the job's handles; None where it is the job's own or the rig does not want it.

    Radial sums by the rig's own scalar kernel, or r² log r where it has none; explicit steps, the row-norm rule at the
    given vertices, every handle straight to its destination. Nothing is refined, mended or proved.
    """
    rig = job.rig
    if Compared.YU2014 not in rig.compare.methods or is_papers_loop(job):
        return None
    straight = rig.deformer.path is PathKind.STRAIGHT
    loop = replace(
        rig,
        drive=rig.drive.plain(),
        deformer=_settings(rig.deformer),
        bones=BoneSettings(),
        surfaces=replace(rig.surfaces, refine=False),
        certificate=CertificateSettings(enabled=False),
        mesh=replace(rig.mesh, refine=False),
    )
    path = job.path if straight else StraightPath(job.handles.source, job.path.position(1.0))
    return replace(job, rig=loop, path=path, stops=job.stops if straight else ())


@dataclass(frozen=True, slots=True)
class LoopProgress:
    """Progress of a march that is not the job's own, whose seconds are told apart."""

    progress: Progress

    @contextmanager
    def stage(self, name: str) -> Iterator[Tick]:
        """Open a stage; the march has another name."""
        with self.progress.stage(LOOP_MARCH if name == MARCH else name) as tick:
            yield tick


def _settings(own: DeformerSettings) -> DeformerSettings:
    many = own.backend is BackendKind.MULTILEVEL  # its handles are too many for one dense system
    scalar = many or (own.backend is BackendKind.RBF and not KERNELS[own.kernel].isochoric)
    return DeformerSettings(
        backend=own.backend if many else BackendKind.RBF,
        kernel=own.kernel if scalar else "r2logr",
        kernel_scale_mm=own.kernel_scale_mm if scalar else None,
        smoothing=own.smoothing if scalar else 0.0,
        max_steps=own.max_steps,
    )
