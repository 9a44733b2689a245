"""A test that is skipped because a package is missing fails under CI, and only there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).resolve().parents[1] / "conftest.py"

FILES = {
    "test_one.py": "import pytest\n\ndef test_it():\n    pytest.importorskip('no_such_package')\n",
    "test_file.py": "import pytest\npytest.importorskip('no_such_package', reason='it is not installed')\n",
    "test_platform.py": "import pytest\n\ndef test_it():\n    pytest.skip('no screen')\n",
}


@pytest.mark.parametrize(("ci", "ends"), [("true", 1), ("", 0)])
def test_a_missing_package_fails_in_ci_alone(tmp_path: Path, ci: str, ends: int) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST.read_text(encoding="utf-8"), encoding="utf-8")
    for name, text in FILES.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")} | {"CI": ci}
    options = [
        "-p",
        "no:cacheprovider",
        "-q",
        "-c",
        os.devnull,
        "--rootdir",
        str(tmp_path),
        "--continue-on-collection-errors",
    ]
    done = subprocess.run(
        [sys.executable, "-m", "pytest", *options, str(tmp_path)],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == ends, done.stdout
    assert ("1 failed, 1 skipped, 1 error" if ends else "3 skipped") in done.stdout
