"""Markers on an OpenSim model: coordinates recovered from markers of known poses; recordings that are refused."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_osim import MODEL

from musclefit.errors import InputError
from musclefit.io import marker_motions
from musclefit.io.formats import c3d as formats_c3d
from musclefit.io.formats.opensim_motion import CoordinateMotion
from musclefit.io.formats.osim import OpenSimModel, parse_osim
from musclefit.io.marker_motions import MarkerFrame, Up, coordinates_of_markers

BODIES = ("hip", "thigh", "shank", "foot")
PLACES = ("0.03 0 0.01", "-0.02 0.03 0", "0 -0.02 0.04", "0.01 0.04 -0.03")


def marked(bodies: tuple[str, ...] = BODIES) -> OpenSimModel:
    """The tiny model with four markers on each of some bodies."""
    markers = "".join(
        f'<Marker name="{body}{k}"><socket_parent_frame>/bodyset/{body}</socket_parent_frame><location>{at}</location>'
        "</Marker>"
        for body in bodies
        for k, at in enumerate(PLACES)
    )
    text = MODEL.replace('<Marker name="heel">', f'{markers}<Marker name="heel">')
    return parse_osim(text.encode(), source="m.osim")


def poses(model: OpenSimModel, count: int = 5) -> list[dict[str, float]]:
    """Smooth poses within the ranges; locked coordinates at rest, coupled ones following."""
    held = {c.dependent for c in model.multibody.couplers} | {
        n for n, c in model.multibody.coordinates.items() if c.locked
    }
    rng = np.random.default_rng(3)
    ways = {name: rng.uniform(-0.6, 0.6, 2) for name in model.multibody.coordinates if name not in held}
    return [
        model.multibody.values({n: w[0] * t + w[1] * t**2 for n, w in ways.items()}) for t in np.linspace(0, 1, count)
    ]


def recorded(model: OpenSimModel, rows: list[dict[str, float]]) -> tuple[list[str], np.ndarray]:
    """Names and (frames, m, 3) places, mm, of the model's markers."""
    markers = [point for point in model.points if point.kind == "Marker"]
    frames = []
    for row in rows:
        places = model.multibody.places(row)
        frames.append([places[point.body](point.at[None])[0] for point in markers])
    return [point.name for point in markers], np.array(frames)


def trc(names: list[str], positions: np.ndarray, *, units: str = "mm", rate: float = 100.0) -> bytes:
    heads = ["Frame#", "Time", *(cell for name in names for cell in (name, "", ""))]
    lines = [
        "PathFileType\t4\t(X/Y/Z)\tx.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits",
        f"{rate}\t{rate}\t{len(positions)}\t{len(names)}\t{units}",
        "\t".join(heads),
        "\t\t" + "\t".join(f"{axis}{k + 1}" for k in range(len(names)) for axis in "XYZ"),
        *(
            f"{k + 1}\t{k / rate!r}\t" + "\t".join("" if np.isnan(x) else repr(float(x)) for x in frame.ravel())
            for k, frame in enumerate(positions)
        ),
    ]
    return ("\n".join(lines) + "\n").encode()


WRITE_C3D = """
import sys
import ezc3d
import numpy as np
path, unit, *names = sys.argv[1:]
positions = np.load(path + ".npy")
made = ezc3d.c3d()
made["parameters"]["POINT"]["RATE"]["value"] = [100.0]
made["parameters"]["POINT"]["LABELS"]["value"] = names
made["parameters"]["POINT"]["UNITS"]["value"] = [unit]
made["data"]["points"] = np.concatenate([positions.transpose(2, 1, 0), np.ones((1, len(names), len(positions)))])
made.write(path)
"""
"""In a process of its own: beside OpenSim's library ezc3d takes vectors for those of another kind."""


def c3d(path: Path, names: list[str], positions: np.ndarray, *, unit: str = "mm") -> bytes:
    pytest.importorskip("ezc3d")
    np.save(f"{path}.npy", positions)
    subprocess.run([sys.executable, "-c", WRITE_C3D, str(path), unit, *names], check=True)
    return path.read_bytes()


def said(motion: CoordinateMotion, code: str) -> str:
    return " ".join(f.message for f in motion.findings if f.code == code)


def assert_recovered(motion: CoordinateMotion, rows: list[dict[str, float]], *, within: float) -> None:
    assert set(motion.values) == set(rows[0]) - {"tilt", "cap_angle"}
    for name, column in motion.values.items():
        np.testing.assert_allclose(column, [row[name] for row in rows], atol=within, err_msg=name)


def test_coordinates_are_recovered_from_markers_in_any_unit() -> None:
    model = marked()
    rows = poses(model)
    names, positions = recorded(model, rows)
    for units, factor in (("mm", 1.0), ("m", 1e-3)):
        motion = coordinates_of_markers(trc(names, positions * factor, units=units), model, source="walk.trc")
        np.testing.assert_allclose(motion.times_s, np.arange(5) / 100)
        assert_recovered(motion, rows, within=1e-6)
    assert not {"coordinates-open", "model-turned", "marker-gaps", "unused-markers"} & {f.code for f in motion.findings}
    assert "17 markers by OpenSim's inverse kinematics" in said(motion, "marker-residuals")


def test_a_recording_with_z_up_and_missing_markers(tmp_path: Path) -> None:
    """As a laboratory has it: .c3d, z up, the subject before each label, a lost marker, another one not known."""
    model = marked()
    rows = poses(model)
    names, positions = recorded(model, rows)
    turned = positions @ np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]])
    turned[2, 4] = np.nan
    labels = [f"Subject:{name}" for name in names] + ["Subject:WAND"]
    data = c3d(tmp_path / "walk.c3d", labels, np.concatenate([turned, np.zeros((5, 1, 3)) + 7], axis=1))
    frame = MarkerFrame(Up.Z)
    motion = coordinates_of_markers(data, model, source="walk.c3d", frame=frame)
    assert_recovered(motion, rows, within=1e-5)  # a .c3d holds 32-bit floats
    assert said(motion, "marker-gaps").endswith("thigh0 (1)")
    assert "WAND" in said(motion, "unused-markers")
    flat = coordinates_of_markers(data, model, source="walk.c3d", frame=MarkerFrame(Up.Y, (0.0, 0.0, 0.0)))
    assert "hip is turned by" in said(flat, "model-turned")


def test_noise_is_told_as_residuals() -> None:
    model = marked()
    rows = poses(model, 3)
    names, positions = recorded(model, rows)
    noisy = positions + np.random.default_rng(0).normal(0.0, 2.0, positions.shape)
    motion = coordinates_of_markers(trc(names, noisy), model, source="walk.trc")
    rms = float(said(motion, "marker-residuals").partition("residual ")[2].split()[0])
    assert 2.0 < rms < 2.0 * np.sqrt(3.0)
    assert sum(f.code == "marker-residual" for f in motion.findings) == 17


def test_coordinates_that_no_marker_fixes_are_named() -> None:
    model = marked(("hip", "thigh"))
    rows = poses(model, 2)
    names, positions = recorded(model, rows)
    kept = names.index("heel")
    motion = coordinates_of_markers(
        trc(names[:kept], positions[:, :kept]), model, source="walk.trc", frame=MarkerFrame(None)
    )
    assert said(motion, "coordinates-open").endswith(": knee, flex")
    assert "1 markers of the model were not recorded: heel" in said(motion, "markers-not-recorded")


def test_markers_in_another_frame_are_refused_with_the_shift_that_fits() -> None:
    """A model fixed to the ground cannot follow a frame 0.8 m off, and must not do so half-way."""
    fixed = MODEL
    for name in ("rx", "ry", "rz", "tx", "ty", "tz"):
        old = f'<Coordinate name="{name}"><default_value>0</default_value><range>-2 2</range><clamped>true</clamped>'
        assert old + "<locked>false" in fixed
        fixed = fixed.replace(old + "<locked>false", old + "<locked>true")
    model = parse_osim(
        fixed.replace(
            '<Marker name="heel">',
            "".join(
                f'<Marker name="{body}{k}"><socket_parent_frame>/bodyset/{body}</socket_parent_frame><location>{at}'
                "</location></Marker>"
                for body in BODIES
                for k, at in enumerate(PLACES)
            )
            + '<Marker name="heel">',
        ).encode(),
        source="m.osim",
    )
    names, positions = recorded(model, [model.multibody.values({"knee": 0.3, "a": 0.2})] * 2)
    data = trc(names, positions - (0.0, 800.0, 0.0))
    with pytest.raises(
        InputError, match=r"another frame or unit.*set drive.markers_shift_mm = \[-?[01], (799|800|801), -?[01]\]"
    ):
        coordinates_of_markers(data, model, source="walk.trc")
    motion = coordinates_of_markers(data, model, source="walk.trc", frame=MarkerFrame(None, (0.0, 800.0, 0.0)))
    np.testing.assert_allclose(motion.values["knee"], 0.3, atol=1e-6)
    with pytest.raises(InputError, match="another frame or unit"):
        coordinates_of_markers(trc(names, positions * 10.0), model, source="walk.trc")


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (
            lambda d: d.replace(b"hip", b"HIP").replace(b"thigh", b"x").replace(b"shank", b"y").replace(b"foot", b"z"),
            "",
        ),
        (lambda d: d[: len(d) // 2], "correct it|cut short"),
        (lambda d: d.replace(b"\tmm\n", b"\tparsec\n"), "Units is 'parsec'"),
        (lambda d: d.replace(b"\n2\t0.01\t", b"\n2\t0.0\t"), "Time is 0.0; expected numbers that rise"),
        (lambda d: d.replace(b"hip1", b"hip0"), "two markers are named 'hip0'"),
        (lambda _: b"", "no .trc file"),
    ],
)
def test_bad_recordings_are_refused(change: object, found: str) -> None:
    model = marked()
    names, positions = recorded(model, poses(model, 3))
    keep = len(names) - 1  # without heel
    data = change(trc(names[:keep], positions[:, :keep]))  # type: ignore[operator]
    with pytest.raises(InputError, match=found or "none of its 16 markers is one of the model's; .*rename"):
        coordinates_of_markers(data, model, source="walk.trc")


def test_a_frame_without_markers_and_bad_c3d(tmp_path: Path) -> None:
    model = marked()
    names, positions = recorded(model, poses(model, 3))
    gone = positions.copy()
    gone[1] = np.nan
    with pytest.raises(InputError, match=r"at 0\.01 s no marker of the model is seen \(1 such frames\); cut"):
        coordinates_of_markers(trc(names, gone), model, source="walk.trc")
    data = c3d(tmp_path / "x.c3d", names, positions, unit="furlong")
    for bad, frame, found in (
        (data, None, "does not say which axis points up"),
        (data, MarkerFrame(Up.Z), "POINT:UNITS is 'furlong'"),
        (b"", MarkerFrame(Up.Z), "is not a C3D file"),
        (data[:700], MarkerFrame(Up.Z), "ezc3d cannot use it|frames of"),
    ):
        with pytest.raises(InputError, match=found):
            coordinates_of_markers(bad, model, source="x.c3d", frame=frame)


def test_a_c3d_that_is_read_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """40 bytes of the parameters are missing, so that ezc3d looks for their end for ever."""
    whole = c3d(tmp_path / "x.c3d", ["subject:A", "B"], np.zeros((3, 2, 3)))
    monkeypatch.setattr(formats_c3d, "CPU_S", 0.5)
    with pytest.raises(InputError, match=r"x\.c3d: ezc3d cannot use it \(no end within 1 s of processor time"):
        formats_c3d.read_c3d(whole[:603] + whole[643:], source="x.c3d")


def test_without_the_library_the_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from musclefit.io.libraries import process

    worker = tmp_path / "worker.py"
    real = Path(process.__file__).with_name("worker.py").read_text()
    worker.write_text(real.replace("import opensim", "import opensim_that_is_not_there as opensim"))
    monkeypatch.setattr(process, "_WORKER", worker)
    model = marked()
    names, positions = recorded(model, poses(model, 2))
    with pytest.raises(InputError, match=r"needs the library opensim, .*pip install 'musclefit\[opensim\]'"):
        coordinates_of_markers(trc(names, positions), model, source="walk.trc")
    assert marker_motions.ENDINGS == (".trc", ".c3d")
