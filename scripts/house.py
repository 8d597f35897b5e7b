"""Print the sizes of the code base: modules, lines of code, import chains, words and callbacks to take out.

`make house` prints them. A line of code carries at least one token that is no comment, docstring or import. A chain is
the longest path of imports at module level (not under TYPE_CHECKING or in functions) between modules of one package.
"""

from __future__ import annotations

import ast
import io
import json
import re
import sys
import tokenize
from collections import defaultdict
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import TypeGuard

ROOT = Path(__file__).resolve().parent.parent
PRODUCT = "appliance"
WORKSHOP = "workshop"
CHAINS = {"whole": "", "plane": "plane", "tasks": "tasks", "tui": "tui"}
DIALECT = re.compile(r"\b(?:whoever|anew|(?:is|are) told)\b", re.IGNORECASE)
LAYOUT = {tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER}
TEXTS = ("appliance", "workshop", "tests", "scripts", "docs", "benchmarks", "models", "locks", "systemd")
"""Folders of text that is written by hand."""
SUFFIXES = {".py", ".md", ".sh", ".toml"}
SKIPPED = {"locks", "data", "benchmarks", "corpus", "schemas"}


def is_text(node: ast.AST) -> TypeGuard[ast.Expr]:
    """Tell whether a statement is a string by itself: a docstring or the description of a field."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def code_lines(source: str) -> int:
    """Count the lines of a module that carry code."""
    without: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import | ast.ImportFrom) or is_text(node):
            without.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - without)


@cache
def imports(path: Path, module: str) -> set[str]:
    """List the names that a module imports when it is loaded."""
    is_package = path.name == "__init__.py"
    found: set[str] = set()
    package = module if is_package else module.rpartition(".")[0]

    def visit(body: list[ast.stmt]) -> None:
        for node in body:
            if isinstance(node, ast.Import):
                found.update(name.name for name in node.names)
            elif isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    parts = package.split(".")[: len(package.split(".")) - node.level + 1]
                    base = ".".join([*parts, base]) if base else ".".join(parts)
                found.update(f"{base}.{name.name}" for name in node.names)
                found.add(base)
            elif isinstance(node, ast.If) and "TYPE_CHECKING" not in ast.unparse(node.test):
                visit(node.body)
                visit(node.orelse)
            elif isinstance(node, ast.Try):
                visit(node.body)

    visit(ast.parse(path.read_text()).body)
    return found


def modules_of(root: Path, package: str) -> dict[str, Path]:
    """Name the modules of a package."""
    found: dict[str, Path] = {}
    for path in sorted((root / package).rglob("*.py")):
        parts = path.relative_to(root).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def longest_chain(modules: dict[str, Path], inside: str) -> list[str]:
    """Find the longest chain of imports among the modules whose names begin with `inside`."""
    chosen = {name: path for name, path in modules.items() if name == inside or name.startswith(f"{inside}.")}
    arrows: dict[str, set[str]] = defaultdict(set)
    for name, path in chosen.items():
        for target in imports(path, name):
            if target in chosen and target != name and not name.startswith(f"{target}."):
                arrows[name].add(target)

    under_way: set[str] = set()

    @cache
    def chain(name: str) -> tuple[str, ...]:
        if name in under_way:
            return ()
        under_way.add(name)
        below = max((chain(target) for target in arrows[name]), key=len, default=())
        under_way.discard(name)
        return (name, *below)

    return list(max((chain(name) for name in chosen), key=len, default=()))


def locals_of(function: ast.FunctionDef | ast.AsyncFunctionDef) -> set[str]:
    """Name the parameters and variables of a function."""
    arguments = function.args
    names = {each.arg for each in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)}
    stored = (node for node in ast.walk(function) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store))
    return names | {node.id for node in stored}


def set_from_outside(tree: ast.Module) -> int:
    """Count the callbacks that are set on another object: `thing.on_lost = self._lost`, `a.b.hook = lambda: …`.

    A variable that is called like a function of the module is none, nor is a field copied under its own name
    (`volume.folder = found.folder`).
    """
    nodes = list(ast.walk(tree))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    names = {function.name for function in functions}

    def is_callback(value: ast.expr, target: ast.Attribute) -> bool:
        if isinstance(value, ast.Attribute):
            return value.attr in names and value.attr != target.attr
        if not isinstance(value, ast.Name):
            return isinstance(value, ast.Lambda)
        around = (each for each in functions if each.lineno <= value.lineno <= (each.end_lineno or each.lineno))
        return value.id in names and not any(value.id in locals_of(function) for function in around)

    count = 0
    for node in (each for each in nodes if isinstance(each, ast.Assign)):
        for target in node.targets:
            if isinstance(target, ast.Attribute) and is_callback(node.value, target):
                own = isinstance(target.value, ast.Name) and target.value.id in {"self", "cls"}
                count += not own
    return count


def texts(root: Path) -> list[Path]:
    """List the files in which the words are counted: code, tests, scripts, documentation, also without a checkout."""
    found = sorted(path for folder in TEXTS for path in (root / folder).rglob("*") if path.suffix in SUFFIXES)
    found += sorted(path for path in root.iterdir() if path.suffix in SUFFIXES)
    return [path for path in found if path.is_file() and not SKIPPED & set(path.relative_to(root).parts)]


def dialect(root: Path) -> dict[str, int]:
    """Count the words to take out, in code and documentation and in tests."""
    found = {"code and docs": 0, "tests": 0}
    for path in texts(root):
        if path != Path(__file__).resolve():
            where = "tests" if root / "tests" in path.parents else "code and docs"
            found[where] += len(DIALECT.findall(path.read_text()))
    return found


@dataclass
class Size:
    """Size of a package or of a room: modules, lines that carry code, all lines."""

    modules: int = 0
    code: int = 0
    lines: int = 0

    def add(self, source: str) -> None:
        """Count one more module."""
        self.modules += 1
        self.code += code_lines(source)
        self.lines += source.count("\n")


@dataclass
class Report:
    """What `make house` prints."""

    packages: dict[str, Size]
    rooms: dict[str, dict[str, Size]]
    tests: int
    chains: dict[str, list[str]]
    callbacks: int
    dialect: dict[str, int]


def measure(root: Path) -> Report:
    """Measure the tree at `root`."""
    packages = {package: Size() for package in (PRODUCT, WORKSHOP)}
    rooms: dict[str, dict[str, Size]] = {package: {} for package in packages}
    callbacks = 0
    for package, size in packages.items():
        for name, path in modules_of(root, package).items():
            source = path.read_text()
            room = (name.split(".")[1:] or ["top"])[0]
            room = room if (root / package / room).is_dir() else "top"
            size.add(source)
            rooms[package].setdefault(room, Size()).add(source)
            callbacks += set_from_outside(ast.parse(source)) if package == PRODUCT else 0
    product = modules_of(root, PRODUCT)
    tests = root / "tests"
    return Report(
        packages=packages,
        rooms=rooms,
        tests=sum(path.read_text().count("\n") for path in tests.rglob("*.py")),
        chains={name: longest_chain(product, f"{PRODUCT}.{room}".rstrip(".")) for name, room in CHAINS.items()},
        callbacks=callbacks,
        dialect=dialect(root),
    )


def show(report: Report) -> None:
    """Print a report as a table."""
    for package, size in report.packages.items():
        print(f"{package}: {size.code:,} lines of code in {size.modules} modules ({size.lines:,} lines in all)")
        for name, room in sorted(report.rooms[package].items(), key=lambda item: -item[1].code):
            print(f"  {name:12} {room.code:6,} in {room.modules:3}")
    print(f"tests: {report.tests:,} lines")
    print("longest import chain: " + ", ".join(f"{name} {len(chain)}" for name, chain in report.chains.items()))
    print(f"callbacks set on another object from outside: {report.callbacks}")
    print("whoever, anew, is told, are told: " + ", ".join(f"{n} in {where}" for where, n in report.dialect.items()))


if __name__ == "__main__":
    measured = measure(ROOT)
    if "--json" in sys.argv[1:]:
        print(json.dumps(asdict(measured), indent=2))
    else:
        show(measured)
