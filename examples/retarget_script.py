"""Load, drive, deform, check, save: ``python examples/retarget_script.py OUT``."""

import sys

import musclefit

change = ["drive.pose.elbow_deg=60", "deformer.method=yu2014"]  # the paper's loop, quick; without it bones stay rigid
job = musclefit.read_rig(musclefit.find_rig("upper_limb"), overrides=change)  # load, and drive
result = musclefit.retarget(job, tets=None)  # deform by the method and in one shot; no tetrahedra
report = musclefit.save(result, sys.argv[1])  # report.html, report.json, surfaces and pictures in one folder

print(report.verdict, report.result.status, f"landmarks within {report.result.landmarks.max_error_mm:.1e} mm")
for check in report.checks:  # what was checked, against which limit
    print("ok  " if check.passed else "FAIL", f"{check.name}: {check.value:.4g} {check.unit}, limit {check.limit:g}")
