"""The measurements of examples/docs/measurements.md: made, kept as one line of JSON each, and written into the page.

    MUSCLEFIT_DATA=... python examples/measure.py run finger left_arm   # minutes each; then writes the page
    python examples/measure.py take finger FOLDER --commit 1a2b3c4 --log TIME.txt  # run before, by time -v
    python examples/measure.py write                                    # the page alone, from what is kept
    python examples/measure.py list

What is kept is examples/docs/measurements.jsonl. Seconds are of the machine at hand, so measure on an idle one.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
KEPT = ROOT / "examples" / "docs" / "measurements.jsonl"
PAGE = ROOT / "examples" / "docs" / "measurements.md"

Record = dict[str, Any]


@dataclass(frozen=True)
class Run:
    """A rig that is run; its report becomes one column of a table."""

    title: str
    table: str
    rig: str
    settings: tuple[str, ...] = ()
    prepare: tuple[str, ...] = ()
    """A command that makes the rig's anatomy first; `{out}` stands for the measurement's folder."""

    def commands(self, out: Path) -> list[list[str]]:
        """What is run, one after the other; the last one is measured."""
        first = [word.format(out=out) for word in self.prepare]
        options = [word for setting in self.settings for word in ("--set", setting)]
        rig = os.path.expandvars(self.rig).format(out=out)
        run = [sys.executable, "-m", "musclefit", "run", rig, "--no-pictures", "--out", str(out / "run"), *options]
        return [[sys.executable, *first], run] if first else [run]


@dataclass(frozen=True)
class Script:
    """A script or a benchmark; the table, or the lines, that it prints are kept."""

    title: str
    command: tuple[str, ...]

    def words(self) -> list[str]:
        """The command line."""
        return [sys.executable, *self.command]


def _raw(name: str) -> tuple[str, ...]:
    return ("examples/measure.py", "prepare", name, "{out}")


def _region(name: str, title: str, *, settings: tuple[str, ...] = ()) -> Run:
    """A region of the whole body, made by `examples/regions.py`."""
    prepare = ("examples/regions.py", name, "--prepare-only", "--out", "{out}")
    return Run(title, "repaired", f"{{out}}/{name}/rig.toml", settings=settings, prepare=prepare)


_UNTUNED = "${MUSCLEFIT_DATA}/untuned"

RUNS = {
    "forearm": Run("forearm: elbow 75°, forearm 70°, the paper's loop", "landmarks", "forearm"),
    "left_arm": Run("left arm: elbow 77°, forearm 40°", "rigid", f"{_UNTUNED}/left_arm.toml"),
    "finger": Run("finger: 40°, 40°, 15°", "rigid", f"{_UNTUNED}/finger.toml"),
    "forearm_rigid": Run("forearm: elbow 75°, forearm 70°", "rigid", "forearm_rigid"),
    "leg": Run("leg: knee 60°, ankle 20°", "rigid", "leg_jump", settings=("bones.lock=true",)),
    "finger_raw": Run("finger, raw surfaces", "repaired", "{out}/rig.toml", prepare=_raw("finger")),
    "left_arm_raw": Run("left arm, raw surfaces", "repaired", "{out}/rig.toml", prepare=_raw("left_arm")),
    "ankle": _region("ankle", "ankle and foot: 9°", settings=("drive.pose.ankle_deg=9",)),
    "wrist": _region("wrist", "wrist and hand: 20°"),
    "hip": _region("hip", "hip: 20°"),
    "shoulder": _region("shoulder", "shoulder: 25°"),
    "knee": _region("knee", "knee: 9°"),
}
"""Name -> a run; names are what `run` and `take` are given."""


def _benchmark(what: str, *options: str) -> tuple[str, ...]:
    return ("-m", "pytest", "-n0", "-s", "-p", "no:cacheprovider", f"tests/benchmarks/test_bench_{what}.py", *options)


SCRIPTS = {
    "backends": Script(
        "Radial sums and free-form deformations, 35 landmarks of the forearm", ("examples/forearm_backends.py",)
    ),
    "motion": Script("The forearm in motion, method by method", ("examples/fig8_forearm_motion.py",)),
    "jump": Script("The leg through its jump, method by method", ("examples/fig9_jump.py",)),
    "bodies": Script("A whole body on two heavier ones, method by method", ("examples/fig7_bodies.py",)),
    "joints": Script("Joints fitted to two bones of known joints", ("tests/joint_campaign.py", "--fits", "20")),
    "control_points": Script("234,777 control points in one run", ("examples/control_points.py",)),
    "bar": Script("A bar against libigl's SLIM", _benchmark("bar")),
    "body": Script("One body with every check, against one SciPy warp", _benchmark("bodies")),
    "radial": Script("Radial sums against peers", _benchmark("radial")),
    "sequence": Script("Two workers against one; a first run against the next", _benchmark("sequence", "-m", "slow")),
    "tets": Script("Tetrahedra", _benchmark("tets")),
    "volumes": Script("Images of 197 × 233 × 189 voxels, against SimpleITK", _benchmark("volumes")),
}
"""Name -> a script, in the order of the page."""

TABLES = ("landmarks", "rigid", "repaired")
"""Of runs; each has a place of its own in the page, and scripts have one together, "scripts"."""


# ------------------------------------------------------------------ what a report says


def worst_volume_change(outcome: Mapping[str, Any]) -> tuple[float, float]:
    """Median and largest change of the muscles' volumes, percent."""
    changes = [abs(t["volume_change_percent"]) for t in outcome["tissues"] if t["kind"] == "muscle"]
    return (statistics.median(changes), max(changes)) if changes else (float("nan"), float("nan"))


def measures(outcome: Mapping[str, Any]) -> Record:
    """The numbers of one method in a report."""
    median, worst = worst_volume_change(outcome)
    rigid = [t["rigidity_mm"] for t in outcome["tissues"] if t["rigidity_mm"] is not None]
    bones = outcome["bones"]
    return {
        "verdict": outcome["verdict"],
        "claim": outcome["map"]["claim"],
        "margin": outcome["map"]["margin"],
        "steps": outcome["steps"],
        "folded": outcome["map"]["folded_points"],
        "smallest_det": outcome["map"]["min_jacobian_determinant"],
        "landmark_mm": outcome["landmarks"]["max_error_mm"],
        "introduced_mm3": outcome["overlap_total"]["introduced_mm3"],
        "volume_percent": [median, worst],
        "bone_mm": max(rigid, default=None),
        "field_off_bones_mm": bones["field_residual_mm"]["max"] if bones else None,
        "exposed_samples": bones["exposed_samples"] if bones else None,
    }


def record_of(
    name: str, report: Mapping[str, Any], cost: Mapping[str, float | None], made: Mapping[str, str]
) -> Record:
    """What is kept of a run's report.

    Parameters
    ----------
    name : str
        The measurement, a key of `RUNS`.
    report : mapping
        report.json of the run.
    cost : mapping
        `cpu_s` and `wall_s`, None where they were not measured.
    made : mapping
        `date` of the run and `commit` of the code that made it.
    """
    others = {key: measures(report[key]) for key in ("paper_loop", "baseline") if report.get(key)}
    memory = report["peak_memory_mb"]
    # Rounded: the file is kept for its table, and noise beyond these digits would only make changes hard to read.
    found: Record = rounded({"name": name, **measures(report), **others, **cost, "memory_mb": memory, **made})
    return found


def rounded(value: Any) -> Any:
    """Numbers to four significant digits."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, Mapping):
        return {key: rounded(part) for key, part in value.items()}
    return [rounded(part) for part in value] if isinstance(value, list) else value


def _now() -> dict[str, str]:
    """The date, and the commit of the code at hand; "dirty" where the package or the rigs differ from it."""

    def git(*words: str) -> str:
        return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=False).stdout.strip()

    dirty = "-dirty" if git("status", "--porcelain", "--", "musclefit", "rigs") else ""
    return {
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "commit": git("rev-parse", "--short", "HEAD") + dirty,
    }


# ------------------------------------------------------------------ measuring


def run(name: str, out: Path) -> Record:
    """Make one measurement.

    Raises
    ------
    SystemExit
        Its command ended otherwise than by a verdict.
    """
    os.environ.setdefault("PYTHONPATH", str(ROOT))
    if name in SCRIPTS:
        return _script(name)
    *before, last = RUNS[name].commands(out / name)
    for command in before:
        subprocess.run(command, cwd=ROOT, check=False)  # a repair that names what tissues lose ends with exit code 1
    began = _used()
    code = subprocess.run(last, cwd=ROOT, check=False).returncode
    cost = {key: after - before for (key, after), before in zip(_used().items(), began.values(), strict=True)}
    if code not in (0, 1):
        raise SystemExit(f"{name}: the run ended with exit code {code}; see its message above")
    report = json.loads((out / name / "run" / "report.json").read_text(encoding="utf-8"))
    return record_of(name, report, cost, _now())


def _script(name: str) -> Record:
    began = _used()
    done = subprocess.run(SCRIPTS[name].words(), cwd=ROOT, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(f"{name}: the script ended with exit code {done.returncode}; see its message above")
    cpu_s = _used()["cpu_s"] - began["cpu_s"]
    return {"name": name, "lines": printed(done.stdout), "cpu_s": float(f"{cpu_s:.4g}")} | _now()


def printed(text: str) -> list[str]:
    """The lines of a script's output that are its own, without those of pytest and without paths of files written."""
    noise = re.compile(
        r"^(=+|\.+|-+|platform |rootdir|plugins|collected|wrote |bringing up|\d+ passed|benchmark|Name |Legend|  )"
    )
    lines = [line.lstrip(".").rstrip() for line in text.splitlines()]
    return [line for line in lines if line and not noise.match(line)]


def _used() -> dict[str, float]:
    """CPU seconds of the child processes that have ended, and the clock."""
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {"cpu_s": spent.ru_utime + spent.ru_stime, "wall_s": time.monotonic()}


def taken(name: str, folder: Path, *, commit: str, log: Path | None = None) -> Record:
    """A measurement of a run that was made before.

    Raises
    ------
    SystemExit
        There is no report, or the log has no times.
    """
    if name not in RUNS:
        raise SystemExit(f"found {name!r}; expected one of {', '.join(RUNS)}")
    path = folder / "report.json"
    if not path.is_file():
        raise SystemExit(f"{path}: not there; give the folder of a run")
    cost: dict[str, float | None] = {"cpu_s": None, "wall_s": None}
    if log is not None:
        said = log.read_text(encoding="utf-8")
        parts = re.findall(r"(?:User|System) time \(seconds\): ([\d.]+)", said)
        clock = re.search(r"Elapsed \(wall clock\) time[^\n]*: ([\d:.]+)$", said, re.M)
        if len(parts) != 2 or clock is None:
            raise SystemExit(f"{log}: found no times; expected the output of /usr/bin/time -v")
        wall = sum(float(part) * 60**k for k, part in enumerate(reversed(clock[1].split(":"))))
        cost = {"cpu_s": sum(map(float, parts)), "wall_s": wall}
    day = datetime.datetime.fromtimestamp(path.stat().st_mtime, tz=datetime.UTC).date().isoformat()
    return record_of(name, json.loads(path.read_text(encoding="utf-8")), cost, {"date": day, "commit": commit})


def prepare(name: str, out: Path) -> None:
    """Repair one of the raw anatomies of `untuned`, and lay its joints and a rig beside it."""
    untuned = Path(os.environ["MUSCLEFIT_DATA"]) / "untuned"
    out.mkdir(parents=True, exist_ok=True)
    repair = ["repair", str(untuned / f"{name}_raw"), str(out / "anatomy"), "--resolve", "priority"]
    subprocess.run([sys.executable, "-m", "musclefit", *repair], check=False)
    rig = (untuned / f"{name}.toml").read_text(encoding="utf-8")
    joints = (untuned / f"{name}_joints.json").read_text(encoding="utf-8")
    (out / "rig.toml").write_text(rig.replace(f'folder = "{name}"', 'folder = "anatomy"'), encoding="utf-8")
    (out / f"{name}_joints.json").write_text(joints, encoding="utf-8")


# ------------------------------------------------------------------ what is kept


def kept(path: Path = KEPT) -> dict[str, Record]:
    """Name -> record, of the file."""
    if not path.is_file():
        return {}
    records = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines() if line]
    return {record["name"]: record for record in records}


def keep(record: Record, path: Path = KEPT) -> None:
    """Put a record into the file, in place of a former one of its name."""
    order = [*RUNS, *SCRIPTS]
    records = kept(path) | {record["name"]: record}
    lines = [json.dumps(records[name], ensure_ascii=False) for name in sorted(records, key=order.index)]
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


# ------------------------------------------------------------------ the page


def _number(value: float | None, unit: str = "") -> str:
    if value is None:
        return "not measured"
    if value == 0.0:
        return "0"
    figure = (
        f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e") if abs(value) < 1e-3 else f"{float(f'{value:.2g}'):,g}"
    )
    return f"{figure} {unit}".rstrip()


def _whole(value: float | None, unit: str) -> str:
    return "not measured" if value is None else f"{value:,.0f} {unit}"


def _pair(values: list[float]) -> str:
    return " / ".join(_number(value) for value in values) + " %"


def _method(record: Record, key: str) -> str:
    if key not in record:
        return "not run"
    other = record[key]
    off, worst = _number(other["bone_mm"], "mm"), _number(other["volume_percent"][1], "%")
    return f"{off}; {worst}; {_number(other['introduced_mm3'], 'mm³')}"


ROWS: dict[str, Callable[[Record], str]] = {
    "verdict, map": lambda r: f"{r['verdict']}, {r['claim']}",
    "steps": lambda r: str(r["steps"]),
    "folded vertices / smallest det J": lambda r: f"{r['folded']} / {_number(r['smallest_det'])}",
    "landmark error": lambda r: _number(r["landmark_mm"], "mm"),
    "introduced overlap": lambda r: _number(r["introduced_mm3"], "mm³"),
    "muscle volume change, median / worst": lambda r: _pair(r["volume_percent"]),
    "bones off rigid, worst": lambda r: _number(r["bone_mm"], "mm"),
    "field off the bones' exposed surface, worst": lambda r: (
        "bones are not held"
        if r["field_off_bones_mm"] is None
        else f"{_number(r['field_off_bones_mm'], 'mm')} of {r['exposed_samples']:,} samples"
    ),
    "the paper's loop: bones off rigid; muscle volume, worst; introduced overlap": lambda r: _method(r, "paper_loop"),
    "one shot: the same": lambda r: _method(r, "baseline"),
    "CPU time, proof included; by the clock": lambda r: f"{_whole(r['cpu_s'], 's')}; {_whole(r['wall_s'], 's')}",
    "peak memory": lambda r: "not measured" if r["memory_mb"] is None else f"{r['memory_mb'] / 1000:.1f} GB",
    "measured": lambda r: f"{r['date']}, {r['commit']}",
}
"""What a row says -> its cell in a run's column."""


def table(name: str, records: Mapping[str, Record]) -> str:
    """The table of runs of one name, or of all scripts; says so where nothing is kept."""
    if name == "scripts":
        return (
            "\n\n".join(_section(records[key]) for key in SCRIPTS if key in records)
            or "Not measured with this version yet."
        )
    columns = [records[key] for key, run in RUNS.items() if run.table == name and key in records]
    if not columns:
        return "Not measured with this version yet."
    head = ["", *(RUNS[record["name"]].title for record in columns)]
    names = ["command", *(f"`measure.py run {record['name']}`" for record in columns)]
    rows = [[row, *(cell(record) for record in columns)] for row, cell in ROWS.items()]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [head, ["---"] * len(head), names, *rows]).replace(
        "|  |", "| |"
    )


def _section(record: Record) -> str:
    name, lines = record["name"], record["lines"]
    said = f"{SCRIPTS[name].title} (`measure.py run {name}`; {record['date']}, {record['commit']}):"
    blocks: list[list[str]] = []
    for line in lines:  # rows of a table beside each other, and other lines as they were printed
        if blocks and (line[0] == "|") == (blocks[-1][0][0] == "|"):
            blocks[-1].append(line)
        else:
            blocks.append([line])
    shown = ["\n".join(b) if b[0][0] == "|" else "\n".join(["```text", *b, "```"]) for b in blocks]
    return "\n\n".join([said, *shown])


def page(text: str, records: Mapping[str, Record]) -> str:
    """The page with its tables written anew.

    Parameters
    ----------
    text : str
        The page; between `<!-- measured: NAME -->` and `<!-- end -->` a table stands.
    records : mapping
        What is kept.

    Raises
    ------
    ValueError
        A table has no place in the page, or more than one.
    """
    for name in (*TABLES, "scripts"):
        place = re.compile(rf"(<!-- measured: {name} -->\n).*?(<!-- end -->)", re.S)
        if len(place.findall(text)) != 1:
            raise ValueError(f"found {len(place.findall(text))} places of {name!r} in the page; expected one")
        new = table(name, records)
        text = place.sub(lambda found, new=new: f"{found[1]}{new}\n{found[2]}", text)  # type: ignore[misc]
    return text


def write() -> None:
    """Write the tables into the page."""
    PAGE.write_text(page(PAGE.read_text(encoding="utf-8"), kept()), encoding="utf-8")
    print(f"wrote {PAGE}")


def main() -> None:
    """Measure, take or write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    acts = parser.add_subparsers(dest="act", required=True)
    running = acts.add_parser("run", help="make measurements; keep them and write the page after each")
    running.add_argument("names", nargs="+", choices=[*RUNS, *SCRIPTS], metavar="NAME")
    running.add_argument("--out", type=Path, default=Path("musclefit-out/measure").resolve(), help="folder for runs")
    taking = acts.add_parser("take", help="keep the numbers of a run that was made before, and write the page")
    taking.add_argument("name", choices=RUNS, metavar="NAME")
    taking.add_argument("folder", type=Path)
    taking.add_argument("--commit", required=True, help="commit of the code that made it")
    taking.add_argument("--log", type=Path, help="output of /usr/bin/time -v of that run")
    acts.add_parser("write", help="write the page from what is kept")
    acts.add_parser("list", help="list the measurements")
    preparing = acts.add_parser("prepare", help="repair one of the raw anatomies")
    preparing.add_argument("name", choices=["finger", "left_arm"])
    preparing.add_argument("out", type=Path)
    given = parser.parse_args()
    if given.act == "list":
        found = kept()
        for name, title in {k: v.title for k, v in (RUNS | SCRIPTS).items()}.items():
            print(f"{name:14} {found[name]['date'] if name in found else 'not kept  '}  {title}")
    elif given.act == "prepare":
        prepare(given.name, given.out)
    elif given.act == "take":
        keep(taken(given.name, given.folder, commit=given.commit, log=given.log))
        write()
    elif given.act == "write":
        write()
    else:
        for name in given.names:
            keep(run(name, given.out))
            write()


if __name__ == "__main__":
    main()
