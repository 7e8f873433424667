"""Mutants: small mistakes put into safety, motion and search one by one, to see whether the tests notice them.

``python -m benchmarks.mutants`` draws places with a seed, changes one operator, number or condition at each, and runs
the tests of that room in a copy of the checkout. A mutant that no test notices is printed with its place.
"""

import argparse
import ast
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[1]
ROOMS: Final = {
    "rig/safety": ["tests/rig/safety", "tests/rig/motion", "tests/rig/plans", "tests/golden"],
    "rig/motion": ["tests/rig/motion", "tests/rig/safety", "tests/rig/plans", "tests/golden"],
    "hbr/dense": ["tests/hbr/dense", "tests/golden"],
}
"""Rooms, and the tests that must notice a mistake in them, the quickest first."""
OPERATORS: Final = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot, ast.IsNot: ast.Is, ast.In: ast.NotIn, ast.NotIn: ast.In,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip
TIME_LIMIT_S: Final = 600
"""After this time a mutant counts as noticed: it hangs."""


class _Place(ast.NodeTransformer):
    """Counts the places of a module at which a mutant is possible, and changes the one with the number ``wanted``."""

    def __init__(self, wanted: int = -1) -> None:
        self.wanted = wanted
        self.count = 0
        self.line = 0

    def visit(self, node: ast.AST) -> ast.AST:
        match node:
            case ast.AnnAssign(value=ast.AST()):  # an annotation computes nothing
                node.value = self.visit(node.value)
            case ast.arguments():
                node.defaults = [self.visit(one) for one in node.defaults]
            case _:
                self.generic_visit(node)
        mutant = _mutant(node)
        if mutant is None:
            return node
        self.count += 1
        if self.count - 1 != self.wanted:
            return node
        self.line = node.lineno  # type: ignore[attr-defined]
        return mutant


def _mutant(node: ast.AST) -> ast.AST | None:
    """Return a node with one small mistake; None if there is none for nodes of its kind."""
    match node:
        case ast.Compare(left=left, ops=[first, *others], comparators=right) if type(first) in OPERATORS:
            return ast.copy_location(ast.Compare(left, [OPERATORS[type(first)](), *others], right), node)
        case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
            return ast.copy_location(ast.BinOp(left, OPERATORS[type(op)](), right), node)
        case ast.BoolOp(op=op, values=values):
            return ast.copy_location(ast.BoolOp(OPERATORS[type(op)](), values), node)
        case ast.If(test=test, body=body, orelse=orelse):
            return ast.copy_location(ast.If(ast.UnaryOp(ast.Not(), test), body, orelse), node)
        case ast.Constant(value=bool(value)):
            return ast.copy_location(ast.Constant(not value), node)
        case ast.Constant(value=int(value) | float(value)):
            return ast.copy_location(ast.Constant(value + 1), node)
    return None


def places(room: str) -> Iterator[tuple[str, int]]:
    """Yield each file and number of a place of a room."""
    for file in sorted((ROOT / room).rglob("*.py")):
        counter = _Place()
        counter.visit(ast.parse(file.read_text()))
        for number in range(counter.count):
            yield str(file.relative_to(ROOT)), number


def is_noticed(checkout: Path, file: str, number: int) -> tuple[bool, int]:
    """Run the tests on one mutant in a checkout; return whether they notice it, and its line."""
    place = _Place(number)
    usual = (ROOT / file).read_text()
    tree = ast.fix_missing_locations(place.visit(ast.parse(usual)))
    room = next(name for name in ROOMS if file.startswith(name))
    (checkout / file).write_text(ast.unparse(tree))
    try:
        for tests in ROOMS[room]:
            command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "-p", "no:randomly", tests]
            environment = {**os.environ, "PYTHONPATH": str(checkout), "PYTHONDONTWRITEBYTECODE": "1"}
            try:
                done = subprocess.run(
                    command, cwd=checkout, env=environment, capture_output=True, timeout=TIME_LIMIT_S, check=False
                )
            except subprocess.TimeoutExpired:
                return True, place.line
            if done.returncode:
                return True, place.line
        return False, place.line
    finally:
        (checkout / file).write_text(usual)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--number", type=int, default=100, help="mutants")
    parser.add_argument("--skip", type=int, default=0, help="mutants that an interrupted run has tried already")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time")
    options = parser.parse_args()
    sample = random.Random(options.seed).sample([one for room in ROOMS for one in places(room)], options.number)
    drawn = sample[options.skip :]
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(options.jobs) as pool:
        free = []
        for job in range(options.jobs):
            checkout = Path(folder) / str(job)
            shutil.copytree(ROOT, checkout, ignore=shutil.ignore_patterns(".venv", ".git", ".tools", "site", "dist"))
            free.append(checkout)

        def tried(place: tuple[str, int]) -> tuple[bool, str]:
            checkout = free.pop()
            try:
                noticed, line = is_noticed(checkout, *place)
            finally:
                free.append(checkout)
            return noticed, f"{place[0]}:{line}"

        noticed = 0
        for found, where in pool.map(tried, drawn):
            noticed += found
            print(f"{'noticed' if found else 'NOT NOTICED'}  {where}", flush=True)
    print(f"{noticed} of {len(drawn)} mutants were noticed.")


if __name__ == "__main__":
    main()
