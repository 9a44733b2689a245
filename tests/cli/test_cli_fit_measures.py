"""`musclefit fit-body` with measures instead of a scan: known girths, before and after; what cannot be is refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from tiny_rigs import egg

import musclefit as mf
from musclefit.cli.commands import main
from musclefit.geometry.meshes import TriMesh
from musclefit.geometry.surfaces.tapes import tapes_across
from musclefit.io.run_folder import ply_bytes
from musclefit.vocabulary import Claim

RADIUS, HEIGHT = 60.0, 600.0
LANDMARKS = {"low": (0, 0, -200), "high": (0, 0, 200), "side": (60, 0, 100)}


SIDES, RINGS = 24, 13


def cylinder() -> TriMesh:
    """A closed cylinder about z, of known girth: 2 pi 60 mm, but for its 24 sides."""
    angles = 2 * np.pi * np.arange(SIDES) / SIDES
    ring = np.stack([RADIUS * np.cos(angles), RADIUS * np.sin(angles), 0 * angles], axis=1)
    heights = np.linspace(-0.5, 0.5, RINGS) * HEIGHT
    vertices = np.vstack(
        [*(ring + np.array([0.0, 0.0, z]) for z in heights), [[0, 0, heights[0]], [0, 0, heights[-1]]]]
    )
    one, two = np.arange(SIDES), np.roll(np.arange(SIDES), -1)
    top = SIDES * (RINGS - 1)
    faces = [
        *(np.stack([one + k, two + k, two + k + SIDES], axis=1) for k in range(0, top, SIDES)),
        *(np.stack([one + k, two + k + SIDES, one + k + SIDES], axis=1) for k in range(0, top, SIDES)),
        np.stack([two, one, np.full(SIDES, top + SIDES)], axis=1),
        np.stack([one + top, two + top, np.full(SIDES, top + SIDES + 1)], axis=1),
    ]
    return TriMesh(vertices, np.vstack(faces))


GIRTH = 2 * 24 * RADIUS * np.sin(np.pi / 24)


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("template")
    (folder / "skin.ply").write_bytes(ply_bytes(cylinder()))
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in LANDMARKS.items()]
    (folder / "marks.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")
    return folder


def fitted(home: Path, folder: Path, text: str, *, name: str = "measures.toml", **options):
    (folder / name).write_text(text)
    return mf.fit_measures(
        home / "skin.ply", folder / name, landmarks=home / "marks.csv", cage=home / "skin.ply", **options
    )


def girth_at(mesh: TriMesh, z: float) -> float:
    return tapes_across(mesh, at=np.array([0.0, 0.0, z]), normal=np.array([0.0, 0.0, 1.0]))[0].length_mm


def test_a_tape_is_as_long_as_an_ellipse_and_spans_what_is_hollow():
    ellipse = egg((5, 0, 0), (50, 30, 80), subdivisions=5)
    tape = tapes_across(ellipse, at=np.array([0.0, 0.0, 1e-6]), normal=np.array([0.0, 0.0, 3.0]))
    h = ((50 - 30) / (50 + 30)) ** 2
    around = np.pi * 80 * (1 + 3 * h / (10 + np.sqrt(4 - 3 * h)))  # Ramanujan
    np.testing.assert_allclose(tape[0].length_mm, around, rtol=1e-3)
    low, high = (trimesh.creation.box(extents=e) for e in ((100, 100, 50), (40, 60, 80)))
    high.apply_translation([0, 30, 0])
    notched = trimesh.boolean.difference([low, high])
    solid = TriMesh(np.array(notched.vertices), np.array(notched.faces, dtype=np.int64))
    assert girth_at(solid, 0.0) == pytest.approx(400.0)
    apart = TriMesh(
        np.vstack([ellipse.vertices, ellipse.vertices + np.array([200.0, 0.0, 0.0])]),
        np.vstack([ellipse.faces, ellipse.faces + len(ellipse.vertices)]),
    )
    assert len(tapes_across(apart, at=np.zeros(3) + 1e-6, normal=np.array([0.0, 0.0, 1.0]))) == 2
    assert tapes_across(apart, at=np.array([0.0, 0.0, 500.0]), normal=np.array([0.0, 0.0, 1.0])) == ()


def test_slopes_of_a_tape_are_its_derivatives():
    mesh = egg((0, 0, 0), (50, 30, 80), subdivisions=3)
    tape = tapes_across(mesh, at=np.array([0.0, 0.0, 7.0]), normal=np.array([0.0, 0.0, 1.0]))[0]
    ways = np.random.default_rng(0).normal(size=tape.points.shape) * [1, 1, 0]
    h = 1e-5
    lengths = [type(tape)(tape.edges, tape.weights, tape.points + s * h * ways).length_mm for s in (1, -1)]
    np.testing.assert_allclose((lengths[0] - lengths[1]) / (2 * h), (tape.slopes * ways).sum(), rtol=0, atol=1e-6)


def test_a_stature_alone_stretches_the_body_and_leaves_its_girths(home, tmp_path):
    fit = fitted(home, tmp_path, '[measures]\nstature = { kind = "stature", value = 66, unit = "cm" }\n').fit
    np.testing.assert_allclose(fit.before_mm, [HEIGHT], rtol=1e-12)
    np.testing.assert_allclose(fit.reached_mm, [660.0], rtol=0, atol=0.01)
    for z in (-250.0, 10.0, 300.0):
        np.testing.assert_allclose(girth_at(fit.skin, z), GIRTH, rtol=1e-6)
    assert fit.rounds == 0


@pytest.mark.parametrize("ending", ["toml", "json", "csv"])
def test_girths_change_where_they_are_measured_and_little_elsewhere(home, tmp_path, ending):
    table = {
        "stature": {"kind": "stature", "value": 630, "unit": "mm"},
        "waist": {"kind": "girth", "value": 42, "unit": "cm", "height": 30.1},
    }
    texts = {
        "json": json.dumps({"measures": table}),
        "csv": "name,kind,value,unit,height\nstature,stature,630,mm,\nwaist,girth,42,cm,30.1\n",
        "toml": "[measures]\nstature = {kind='stature', value=630, unit='mm'}\n"
        "waist = {kind='girth', value=42, unit='cm', height=30.1}\n",
    }
    result = fitted(home, tmp_path, texts[ending], name=f"measures.{ending}")
    fit = result.fit
    np.testing.assert_allclose(fit.before_mm, [600.0, GIRTH], rtol=1e-6)
    np.testing.assert_allclose(fit.reached_mm, [630.0, 420.0], rtol=0, atol=0.01)
    middle = fit.skin.vertices[:, 2].min() + 630.0 * 301 / 600
    np.testing.assert_allclose(girth_at(fit.skin, middle), 420.0, rtol=0, atol=0.02)
    assert abs(girth_at(fit.skin, middle + 270.0) - GIRTH) < 0.25 * (420.0 - GIRTH)
    assert [row["unit"] for row in result.measures()] == ["mm", "cm"]
    assert result.measures()[1]["reached"] == pytest.approx(42.0, abs=1e-3)


def test_lengths_and_girths_between_landmarks(home, tmp_path):
    text = (
        "[measures]\nstature = {kind='stature', value=600, unit='mm'}\n"
        "limb = {kind='length', value=420, unit='mm', from='low', to='high'}\n"
        "halfway = {kind='girth', value=360, unit='mm', from='low', to='high'}\n"
        "beside = {kind='girth', value=390, unit='mm', at='side'}\n"
    )
    fit = fitted(home, tmp_path, text).fit
    np.testing.assert_allclose(fit.before_mm, [600.0, 400.0, GIRTH, GIRTH], rtol=1e-3)
    np.testing.assert_allclose(fit.reached_mm, [600.0, 420.0, 360.0, 390.0], rtol=0, atol=0.01)
    assert fit.crossings == 0
    ends = fit.deformation(np.array([LANDMARKS["low"], LANDMARKS["high"]], dtype=float))
    np.testing.assert_allclose(np.linalg.norm(ends[1] - ends[0]), 420.0, rtol=0, atol=0.01)


def test_the_folder_holds_a_rig_that_runs_certified(home, tmp_path, capsys):
    (tmp_path / "bone.ply").write_bytes(ply_bytes(egg((0, 0, 0), (20, 20, 150))))
    (tmp_path / "m.csv").write_text("name,kind,value,unit,height\nwaist,girth,400,mm,300.5\n")
    out = tmp_path / "fit"
    skin = str(home / "skin.ply")
    code = main(
        ["fit-body", skin, str(tmp_path / "m.csv"), str(out), "--cage", skin, "--anatomy", str(tmp_path / "bone.ply")]
    )
    said = capsys.readouterr().out
    assert code == 0
    assert f"waist: {GIRTH:.5g} mm, wanted 400, is 400\n" in said
    assert "1 measures are met within" in said
    done = mf.run(out / "body.toml", tets=False)
    assert done.report.result.map.claim is Claim.CERTIFIED
    assert sorted(t.name for t in done.rest) == ["bone", "skin"]
    report = json.loads((out / "fit.json").read_text())
    assert report["measures"][0]["reached"] == pytest.approx(400.0, abs=0.01)
    assert report["volume_litres"]["fitted"] > report["volume_litres"]["template"]


WRONG = {
    "stature = {kind='stature', value=1.8, unit='mm'}": "600 mm: 0.003 times as much; correct the value or its unit",
    "stature = {kind='stature', value=0.63, unit='mm'}": 'did you mean unit = "m"',
    "stature = {kind='stature', value=63, unit='mm'}": 'did you mean unit = "cm"',
    "stature = {kind='stature', value=63, unit='inch'}": "found 'inch'",
    "stature = {kind='stature', value=63}": "stature.unit: is missing",
    "stature = {kind='stature', value='tall', unit='mm'}": "found the text 'tall'; expected a number",
    "stature = {kind='stature', value=-600, unit='mm'}": "expected a length above 0",
    "stature = {kind='statur', value=600, unit='mm'}": "did you mean 'stature'",
    "stature = {kind='stature', value=600, unit='mm', height=3}": "unknown key",
    "w = {kind='girth', value=400, unit='mm'}": "say at which height",
    "w = {kind='girth', value=400, unit='mm', height=700}": "600 mm from its lowest",
    "w = {kind='girth', value=400, unit='mm', height=300, at='side'}": "stands beside a height",
    "w = {kind='girth', value=400, unit='mm', at='navel'}": "no landmark 'navel' on the template; known: high",
    "w = {kind='length', value=400, unit='mm', from='low'}": "to: is missing",
    "w = {kind='length', value=400, unit='mm', from='low', to='low'}": "stand at one place",
    "a = {kind='girth', value=400, unit='mm', height=300}\n"
    "b = {kind='girth', value=41, unit='cm', height=30}": "the same as 'a'",
    "a = {kind='length', value=420, unit='mm', from='low', to='high'}\n"
    "b = {kind='stature', value=600, unit='mm'}\n"
    "c = {kind='girth', value=380, unit='mm', height=300}\n"
    "d = {kind='girth', value=300, unit='mm', height=300.000001}": "cannot be met together",
    "": "holds no measure",
}  # fmt: skip


@pytest.mark.parametrize("text", WRONG)
def test_measures_that_cannot_be_are_refused_with_a_remedy_and_nothing_is_written(home, tmp_path, capsys, text):
    given, out, skin = tmp_path / "m.toml", tmp_path / "fit", str(home / "skin.ply")
    given.write_text(f"[measures]\n{text}\n")
    more = ["--cage", skin, "--template-landmarks", str(home / "marks.csv"), "--quiet"]
    assert main(["fit-body", skin, str(given), str(out), *more]) == 2
    assert WRONG[text] in capsys.readouterr().err
    assert not out.exists()


def test_options_of_scans_are_refused_beside_measures_and_the_other_way_round(home, tmp_path, capsys):
    skin, given = str(home / "skin.ply"), tmp_path / "m.toml"
    given.write_text("[measures]\nstature = {kind='stature', value=600, unit='mm'}\n")
    for arguments, said in (
        ([skin, str(given), str(tmp_path / "o"), "--scan-units", "m"], "--scan-units: is for scans"),
        ([skin, str(given), str(tmp_path / "o"), "--median-mm", "1"], "--median-mm: is for scans"),
        ([skin, skin, str(tmp_path / "o"), "--up", "y"], "--up: is for measures"),
    ):
        assert main(["fit-body", *arguments]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.slow
def test_the_built_in_limb_gets_another_girth_and_length(tmp_path):
    skin = next(tissue.surface for tissue in mf.upper_limb() if tissue.name == "skin")
    (tmp_path / "skin.ply").write_bytes(ply_bytes(skin))
    low, high = skin.vertices[:, 2].min(), skin.vertices[:, 2].max()
    middle = skin.vertices.mean(axis=0)
    ends = {"wrist": 0.8 * low + 0.2 * high, "top": 0.2 * low + 0.8 * high}
    rows = [f"{name},{middle[0]},{middle[1]},{z}" for name, z in ends.items()]
    (tmp_path / "marks.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows]) + "\n")
    around = girth_at(skin, 0.5 * (low + high))
    given = {"forearm": (1.05 * 0.6 * (high - low), "length"), "elbow": (1.08 * around, "girth")}
    lines = [f"{name},{kind},{value},mm,wrist,top" for name, (value, kind) in given.items()]
    (tmp_path / "m.csv").write_text("\n".join(["name,kind,value,unit,from,to", *lines]) + "\n")
    fit = mf.fit_measures(tmp_path / "skin.ply", tmp_path / "m.csv", landmarks=tmp_path / "marks.csv", vertices=120).fit
    np.testing.assert_allclose(fit.reached_mm, [value for value, _ in given.values()], rtol=0, atol=0.01)
    np.testing.assert_allclose(fit.reached_mm / fit.before_mm, [1.05, 1.08], rtol=0, atol=1e-3)
    assert fit.crossings == 0
