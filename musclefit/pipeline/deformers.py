"""From a rig's settings to a deformation of its handles; orders `fields` and `flow`, knows no formula and no file."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

from musclefit.fields.ffd_fit import FfdBackend
from musclefit.fields.protocol import Backend
from musclefit.fields.rbf import RadialBackend
from musclefit.flow.deformation import Deformation
from musclefit.flow.march import Stepper, cayley_step, explicit_step, march, one_shot, points_beside
from musclefit.flow.rules import rule_for
from musclefit.geometry.arrays import Points
from musclefit.progress import Progress
from musclefit.rig.job import Job
from musclefit.rig.model import BackendKind, DeformerSettings, StepKind, TestedAt

STEPPERS: Mapping[StepKind, Stepper] = MappingProxyType(
    {StepKind.EXPLICIT: explicit_step, StepKind.CAYLEY: cayley_step}
)


def backend_for(settings: DeformerSettings) -> Backend:
    """The backend that the settings name."""
    builders: Mapping[BackendKind, Callable[[], Backend]] = {
        BackendKind.RBF: lambda: RadialBackend(settings.kernel.value),
        BackendKind.FFD: lambda: FfdBackend(settings.lattice_spacing_mm, settings.lattice_levels),
    }
    return builders[settings.backend]()


def deform(job: Job, points: Points, *, progress: Progress) -> Deformation:
    """March the job's handles to their destinations; ``points`` (N, 3) mm at rest are what the rule is tested at."""
    settings = job.rig.deformer
    tested = points if settings.tested_at is TestedAt.ALL_POINTS else points_beside(job.handles.source)
    return march(
        job.path,
        backend_for(settings),
        stepper=STEPPERS[settings.step],
        rule=rule_for(settings.step, settings.step_rule),
        tested=tested,
        max_steps=settings.max_steps,
        progress=progress,
    )


def deform_in_one_shot(job: Job, points: Points) -> Deformation:
    """The baseline: the same handles and kernel in one explicit step that is held to no rule."""
    settings = job.rig.deformer
    rule = rule_for(StepKind.EXPLICIT, settings.step_rule)
    return one_shot(job.path, backend_for(settings), rule=rule, tested=points)


def method_in_words(settings: DeformerSettings) -> str:
    """The method, for reports."""
    name = "iterative {} (Yu et al. 2014)" if settings.step is StepKind.EXPLICIT else "implicit midpoint {}"
    field = field_in_words(settings)
    return f"{name.format(field)}, {rule_in_words(settings)}, {settings.path.value} paths"


def field_in_words(settings: DeformerSettings) -> str:
    """The backend and its own settings, for reports."""
    if settings.backend is BackendKind.FFD:
        return f"FFD, lattice {settings.lattice_spacing_mm:g} mm"
    return f"RBF, kernel {settings.kernel.value}"


def rule_in_words(settings: DeformerSettings) -> str:
    """The step rule and where it was tested, for reports."""
    rule = "eigenvalues of the symmetric gradient" if settings.step is StepKind.CAYLEY else settings.step_rule.value
    where = "all points" if settings.tested_at is TestedAt.ALL_POINTS else "landmarks only"
    return f"{rule} at {where}"
