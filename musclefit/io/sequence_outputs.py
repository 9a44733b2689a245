"""What people look at: page, plots, film and animated model of a sequence; measures nothing."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from musclefit.io.sequences import SequencePlan
from musclefit.progress import Progress
from musclefit.report.sequence import SequenceReport


def write_outputs(
    plan: SequencePlan,
    folder: Path,
    report: SequenceReport,
    *,
    film: bool,
    seconds: Mapping[str, float],
    progress: Progress,
) -> None:
    """Write page, plots, film and animated model of a sequence into its folder."""
