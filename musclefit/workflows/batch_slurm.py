"""The script of a SLURM array: a study and a forecast in, a script out that runs one case per task."""

from __future__ import annotations

import math
import shlex
from pathlib import Path

from musclefit.io.atomic import write_atomically
from musclefit.io.studies import Study
from musclefit.workflows.cost import Forecast
from musclefit.workflows.worker_pool import PINNED

SCRIPT, CASES, LOGS = "slurm.sh", "cases.txt", "logs"

_LEAST_MB, _LEAST_MINUTES, _SPARE_MB, _SPARE_TIME = 2000, 30, 1.5, 3.0
"""What a task asks for at least, and by how much more than the forecast."""


def write_slurm(study: Study, out: Path, expected: Forecast) -> Path:
    """Write the script and the list of cases that it reads; a case per line, a line per task.

    Each task's command may be run again at any time: a case that is done is kept. The paths of study and results are
    absolute, so that the script may be started anywhere.
    """
    mb = max(_LEAST_MB, math.ceil(_SPARE_MB * expected.peak_mb))
    minutes = max(_LEAST_MINUTES, math.ceil(_SPARE_TIME * expected.cpu_s / max(1, expected.cases) / 60.0))
    (out / LOGS).mkdir(parents=True, exist_ok=True)
    write_atomically(out / CASES, "".join(f"{case.name}\n" for case in study.cases))
    study_file, cases = study.source.absolute(), out / CASES
    lines = [
        "#!/bin/bash",
        "#SBATCH --job-name=musclefit",
        f"#SBATCH --array=1-{len(study.cases)}",
        "#SBATCH --cpus-per-task=1",
        f"#SBATCH --mem={mb}M",
        f"#SBATCH --time={minutes}",
        f"#SBATCH --output={_in_directive(out / LOGS)}/%a.txt",
        "# Tasks beyond the cluster's MaxArraySize need arrays of their own: sbatch --array=1001-2000 and so on.",
        "# Afterwards: musclefit collect " + shlex.quote(str(out)),
        "set -euo pipefail",
        f"export {' '.join(f'{name}=1' for name in PINNED)}",
        f'case=$(sed -n "${{SLURM_ARRAY_TASK_ID}}p" {shlex.quote(str(cases))})',
        f'musclefit batch {shlex.quote(str(study_file))} --out {shlex.quote(str(out))} --only "$case" --quiet',
    ]
    return write_atomically(out / SCRIPT, "\n".join(lines) + "\n")


def _in_directive(path: Path) -> str:
    """A path as SLURM reads it in a directive: % stands for itself when doubled."""
    text = str(path).replace("%", "%%")
    return f'"{text}"' if " " in text else text
