"""The commands about rig files: which come along, and a new one to start from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from musclefit.cli.options import JsonOption, print_json

PASSED = 0


def rigs(*, json: JsonOption = False) -> int:
    """List the rigs that come with musclefit: name, title, and the data they need."""
    import tomllib

    from musclefit.io.named_files import DATA_VARIABLE
    from musclefit.io.rig_names import builtin_rig_path, builtin_rigs

    texts = {name: builtin_rig_path(name).read_text(encoding="utf-8") for name in builtin_rigs()}
    titles = {name: tomllib.loads(text)["title"] for name, text in texts.items()}
    if json:
        told = [{"name": name, "title": titles[name], "needs_data": DATA_VARIABLE in texts[name]} for name in texts]
        print_json({"rigs": told})
        return PASSED
    for name, text in texts.items():
        needs = f"  (needs {DATA_VARIABLE})" if DATA_VARIABLE in text else ""
        print(f"{name:<16} {titles[name]}{needs}")
    return PASSED


def init(
    rig: Annotated[Path, Parameter(help="The rig file to write, such as knee.toml; one that is there is kept.")],
    /,
    *,
    anatomy: Annotated[
        Path | None, Parameter(name="--anatomy", help="Folder of surfaces, one per tissue. Without it: a placeholder.")
    ] = None,
    joints: Annotated[
        Path | None, Parameter(name="--joints", help="Table of joints. Without it: a placeholder.")
    ] = None,
) -> int:
    """Write a ten-line rig to start from: your surfaces, your joints, a pose."""
    from musclefit.workflows.init import init as write

    made = write(rig, anatomy=anatomy, joints=joints)
    print(f"wrote {rig}: {made}")
    return PASSED


def schema(
    of: Annotated[Literal["rig", "report", "check"], Parameter(help="Which schema to print.")],
    /,
) -> int:
    """Print the JSON Schema of rig files, or of the report of a run or check."""
    import json

    from musclefit.workflows.schemas import schema as made

    print(json.dumps(made(of), indent=2, ensure_ascii=False))
    return PASSED
