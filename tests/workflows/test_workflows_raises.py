"""What a public function raises is named by its docstring; read from the source, so that no way into it is missed."""

from __future__ import annotations

import ast
import builtins
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from inspect import isfunction
from pathlib import Path

import pytest

import musclefit
from musclefit import errors

PACKAGE = Path(musclefit.__file__).parent
BASES = {
    name: tuple(base.__name__ for base in found.__mro__)
    for home in (builtins, errors)
    for name, found in vars(home).items()
    if isinstance(found, type) and issubclass(found, Exception)
}
"""Exception classes by name, with the names of all that catch them."""


def test_public_functions_name_all_that_they_raise() -> None:
    """Commands are left out: their docstrings are help, and what they refuse ends with exit code 2."""
    unnamed, raising = {}, 0
    for path, tree in raising_modules():
        for function in public_functions(tree):
            raised = raised_by(function, tree)
            raising += bool(raised)
            if missing := raised - named_by(function):
                unnamed[f"{path.relative_to(PACKAGE)}: {function.name}"] = sorted(missing)
    assert unnamed == {}
    assert raising > 200


def test_public_methods_name_all_that_they_raise() -> None:
    """What a class raises when it is made stands in its own docstring."""
    unnamed, raising = {}, 0
    for path, tree in raising_modules():
        for owner, method in public_methods(tree):
            raised = raised_by(method, tree) - {"AssertionError"}
            raising += bool(raised)
            if missing := raised - named_by(owner if method.name in MAKING else method):
                unnamed[f"{path.relative_to(PACKAGE)}: {owner.name}.{method.name}"] = sorted(missing)
    assert unnamed == {}
    assert raising > 100


def test_what_is_exported_names_it_under_raises() -> None:
    unnamed, seen = {}, 0
    for path in sorted(PACKAGE.rglob("__init__.py")):
        room = import_module(".".join(("musclefit", *path.parent.relative_to(PACKAGE).parts)))
        for name in getattr(room, "__all__", ()):
            exported = getattr(room, name)
            if not isfunction(exported):
                continue
            tree = parsed(Path(exported.__code__.co_filename))
            (function,) = (found for found in public_functions(tree) if found.name == exported.__name__)
            seen += 1
            if missing := raised_by(function, tree) - under_raises(function):
                unnamed[f"{room.__name__}.{name}"] = sorted(missing)
    assert unnamed == {}
    assert seen > 40


@cache
def parsed(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def raising_modules() -> Iterator[tuple[Path, ast.Module]]:
    """The modules that raise something, commands left out."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if path.parent != PACKAGE / "cli" and "raise " in path.read_text(encoding="utf-8"):
            yield path, parsed(path)


def public_functions(tree: ast.Module) -> Iterator[ast.FunctionDef]:
    """The functions of a module whose names do not begin with an underscore."""
    return (node for node in tree.body if isinstance(node, ast.FunctionDef) and not node.name.startswith("_"))


MAKING = ("__init__", "__post_init__")


def public_methods(tree: ast.Module) -> Iterator[tuple[ast.ClassDef, ast.FunctionDef]]:
    """Methods of the public classes of a module, those that make one and those that call one among them."""
    for owner in tree.body:
        if isinstance(owner, ast.ClassDef) and not owner.name.startswith("_"):
            for node in owner.body:
                named = isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
                if isinstance(node, ast.FunctionDef) and (named or node.name in (*MAKING, "__call__")):
                    yield owner, node


def raised_by(function: ast.FunctionDef, tree: ast.Module) -> set[str]:
    """Exception classes that a function, or a private function of its module that it calls, raises by name."""
    functions = {node.name: node for node in tree.body if isinstance(node, ast.FunctionDef)}
    groups = {
        target.id: {name.id for name in ast.walk(node.value) if isinstance(name, ast.Name)}
        for node in tree.body
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple)
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    return set(_leaving(function, _Module(functions, groups)))


@dataclass(frozen=True)
class _Module:
    """Functions by name, and what is in tuples of exception classes."""

    functions: dict[str, ast.FunctionDef]
    groups: dict[str, set[str]]

    def classes(self, handler: ast.ExceptHandler) -> set[str]:
        """What a handler catches."""
        names = {name.id for name in ast.walk(handler.type or handler) if isinstance(name, ast.Name)}
        return names.union(*(self.groups.get(name, set()) for name in names))


def _leaving(
    node: ast.AST, module: _Module, caught: frozenset[str] = frozenset(), *, follow: bool = True
) -> Iterator[str]:
    """Classes that leave ``node``; an error made by a function of the module is what that function returns."""
    if isinstance(node, ast.Try):
        here = {name for handler in node.handlers if handler.type is not None for name in module.classes(handler)}
        for child in node.body:
            yield from _leaving(child, module, caught | here, follow=follow)
        parts = (*node.handlers, *node.orelse, *node.finalbody)
    else:
        parts = tuple(ast.iter_child_nodes(node))
    for child in parts:
        yield from _leaving(child, module, caught, follow=follow)
    if isinstance(node, ast.Raise):
        made = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
        name = made.id if isinstance(made, ast.Name) else ""
        if name in module.functions and module.functions[name].returns:
            name = ast.unparse(module.functions[name].returns)
        if name in BASES and not caught.intersection(BASES[name]):
            yield name
    called = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
    if follow and called.startswith("_") and called in module.functions:
        yield from _leaving(module.functions[called], module, caught, follow=False)


def under_raises(function: ast.FunctionDef | ast.ClassDef) -> set[str]:
    """The names that head the entries of the section Raises."""
    said = re.search(r"^Raises\n-+\n(.*?)(?=^\w+\n-+$|\Z)", ast.get_docstring(function) or "", re.MULTILINE | re.DOTALL)
    return {name for line in re.findall(r"^\S.*$", said[1] if said else "", re.MULTILINE) for name in line.split(", ")}


def named_by(function: ast.FunctionDef | ast.ClassDef) -> set[str]:
    """What stands under Raises; a docstring without sections may say it in its words ("Raise RigError unless ...")."""
    text = ast.get_docstring(function) or ""
    return under_raises(function) if re.search(r"^-+$", text, re.MULTILINE) else set(re.findall(r"\w+", text))


DIRECT = """
def f():
    '''Raise KeyError.'''
    raise KeyError("k")
"""
SECTION = """
def f():
    '''F.

    Raises
    ------
    OSError, KeyError
        Ever.
    '''
"""
HELPER = """
def f():
    _g()
def _g():
    raise MeshError("m")
"""
MAKER = """
def f():
    raise _g()
def _g() -> RigError: ...
"""
CAUGHT = """
def f():
    try:
        raise MeshError
    except InputError:
        raise OSError from None
"""
NOT_CAUGHT = """
def f():
    try:
        raise InputError
    except MeshError:
        raise
"""
HELPER_CAUGHT = """
def f():
    try:
        _g()
    except KeyError as error:
        raise error
def _g():
    raise KeyError
"""


@pytest.mark.parametrize(
    ("source", "raised", "named"),
    [
        (DIRECT, {"KeyError"}, {"Raise", "KeyError"}),
        (SECTION, set(), {"OSError", "KeyError"}),
        (HELPER, {"MeshError"}, set()),
        (MAKER, {"RigError"}, set()),
        (CAUGHT, {"OSError"}, set()),
        (NOT_CAUGHT, {"InputError"}, set()),
        (HELPER_CAUGHT, set(), set()),
    ],
)
def test_raised_and_named_are_read_from_the_source(source: str, raised: set[str], named: set[str]) -> None:
    tree = ast.parse(source)
    function = next(public_functions(tree))
    assert raised_by(function, tree) == raised
    assert named_by(function) == named
