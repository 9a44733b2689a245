"""What all tests share: where the real anatomy is, and one thread for each of the processes that run them."""

from __future__ import annotations

import os
from pathlib import Path

if "PYTEST_XDIST_WORKER" in os.environ:  # before numpy is imported, which reads them once
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(name, "1")

import pytest

CI = os.environ.get("CI") == "true"


def _package_is_missing(report: pytest.TestReport | pytest.CollectReport) -> str:
    """Why a test was skipped, where that is a package that is not installed; else ""."""
    reason = report.longrepr[2] if report.skipped and isinstance(report.longrepr, tuple) else ""
    return reason if "could not import" in reason or "is not installed" in reason else ""


def _fail_where_a_package_is_missing(report: pytest.TestReport | pytest.CollectReport) -> None:
    if CI and (reason := _package_is_missing(report)):
        report.outcome = "failed"
        report.longrepr = f"{reason}: the extra `test` installs it, so that no test is skipped in CI"


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]):
    """Under CI a skip for a package that the extra `test` installs is a failure."""
    report = yield
    _fail_where_a_package_is_missing(report)
    return report


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(collector: pytest.Collector):
    """The same where a whole file is skipped."""
    report = yield
    _fail_where_a_package_is_missing(report)
    return report


@pytest.fixture(scope="session")
def anatomy_data() -> Path:
    """The folder of real anatomy; its tests skip where it is absent, but fail under CI."""
    root = Path(__file__).resolve().parents[1]
    folder = Path(os.environ.get("MUSCLEFIT_DATA", root.parent / "shared" / "data"))
    if not (folder / "arm" / "joints.json").is_file():
        reason = f"no real anatomy in {folder}; set MUSCLEFIT_DATA to its folder"
        if CI:
            pytest.fail(reason)
        pytest.skip(reason)
    return folder
