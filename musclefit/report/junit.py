"""An inspection as JUnit XML, which continuous integration shows: a test case for each check and each tissue."""

from __future__ import annotations

from xml.etree import ElementTree

from musclefit.report.model import MeshReport


def junit_xml(report: MeshReport) -> str:
    """The checks of an inspection, and of each tissue the findings that fail it, as JUnit XML."""
    suite = ElementTree.Element("testsuite", name="musclefit check")
    failures = 0
    for check in report.checks:
        case = ElementTree.SubElement(suite, "testcase", classname="checks", name=_plain(check.name))
        if not check.passed:
            failures += 1
            message = f"{check.value:g} {check.unit}, at most {check.limit:g}: {check.place}. {check.next_step}"
            ElementTree.SubElement(case, "failure", message=_plain(message))
    failing = {"unusable", *report.fail_on}
    names = dict.fromkeys(
        [*(t.name for t in report.tissues), *(f.subject for f in report.findings if f.code in failing)]
    )
    for name in names:
        case = ElementTree.SubElement(suite, "testcase", classname="tissues", name=_plain(name))
        found = [f for f in report.findings if f.subject == name and f.code in failing]
        failures += bool(found)
        if found:
            said = "; ".join(finding.message for finding in found)
            ElementTree.SubElement(case, "failure", message=_plain(said))
    suite.set("tests", str(len(suite)))
    suite.set("failures", str(failures))
    return ElementTree.tostring(suite, encoding="unicode", xml_declaration=False) + "\n"


def _plain(text: str) -> str:
    """The text without what XML cannot hold."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
