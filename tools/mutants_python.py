"""Mutants of Python source: every small wrong change of one file, as changes of its syntax tree.

Changed are comparisons (with their boundaries), boolean and arithmetic operators, operands of `and` and `or`,
negations and conditions, numbers (integers by one, others by a tenth), min and max, any and all, caught exceptions,
returned values, and statements (left out). Strings, annotations, decorators and assertions are not changed.
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import CodeType

COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
ARITHMETIC: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Div,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitOr,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
FUNCTIONS = {"min": "max", "max": "min", "any": "all", "all": "any"}
UNCHANGED_FIELDS = ("annotation", "returns", "decorator_list", "format_spec", "ops", "op", "ctx")
STATEMENTS = (ast.Expr, ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Raise, ast.Return, ast.Continue, ast.Break)


@dataclass
class Mutant:
    """One change: `replacement` instead of one node of `tree`."""

    name: str  # the entry in the list of equivalents; it has the line's text, because line numbers change
    line: int
    tree: ast.Module = field(repr=False)
    parent: ast.AST = field(repr=False)
    field_name: str
    index: int | None  # in the field, if that is a list
    replacement: ast.AST = field(repr=False)

    def compile(self, path: Path) -> CodeType:
        """The code of the changed module. It changes the tree that all mutants share: call it in a process that ends
        afterwards."""
        if self.index is None:
            setattr(self.parent, self.field_name, self.replacement)
        else:
            getattr(self.parent, self.field_name)[self.index] = self.replacement
        return compile(ast.fix_missing_locations(self.tree), path, "exec")


def mutants(path: Path, label: str) -> list[Mutant]:
    """All mutants of one file, in the order of its lines; `label` names the file."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    lines = source.splitlines()
    places = sorted(_places(tree, ""), key=lambda place: place[1])
    repeated: Counter[str] = Counter()
    result = []
    for scope, line, parent, field_name, index, node in places:
        for replacement in _replacements(parent, field_name, node):
            change = f"{_shown(node)} -> {_shown(replacement)}"
            text = lines[line - 1].split("  #")[0].strip()
            name = f"{label} {scope}: {text} | {change}"
            repeated[name] += 1
            if repeated[name] > 1:
                name += f" ({repeated[name]})"
            result.append(Mutant(name, line, tree, parent, field_name, index, replacement))
    return result


def _shown(node: ast.AST) -> str:
    if isinstance(node, ast.Pass):
        return "(left out)"
    if isinstance(node, STATEMENTS) and not _short(node):
        return "statement"
    return " ".join(ast.unparse(node).split())


def _short(node: ast.AST) -> bool:
    return isinstance(node, ast.Return) and (node.value is None or isinstance(node.value, ast.Constant))


def _places(node: ast.AST, scope: str) -> Iterator[tuple[str, int, ast.AST, str, int | None, ast.AST]]:
    """(scope, line, parent, field, index, node) of each node below this one that may change."""
    if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
        scope = f"{scope}.{node.name}".lstrip(".")
    for name, value in ast.iter_fields(node):
        if name in UNCHANGED_FIELDS:
            continue
        children = list(enumerate(value)) if isinstance(value, list) else [(None, value)]
        for index, child in children:
            if not isinstance(child, ast.AST) or isinstance(child, ast.Assert):
                continue
            if hasattr(child, "lineno"):
                yield scope or "(module)", child.lineno, node, name, index, child
            yield from _places(child, scope)


def _replacements(parent: ast.AST, field_name: str, node: ast.AST) -> Iterator[ast.AST]:
    """The replacements of one node."""
    if field_name in ("test", "ifs") and not isinstance(node, (ast.Compare, ast.BoolOp, ast.UnaryOp)):
        yield ast.UnaryOp(ast.Not(), node)
    if isinstance(node, ast.Compare):
        for position, operator in enumerate(node.ops):
            for other in COMPARISONS[type(operator)]:
                changed = copy.copy(node)
                changed.ops = [*node.ops[:position], other(), *node.ops[position + 1 :]]
                yield changed
    elif isinstance(node, ast.BoolOp):
        yield ast.BoolOp(ast.Or() if isinstance(node.op, ast.And) else ast.And(), node.values)
        for left_out in range(len(node.values)):
            kept = node.values[:left_out] + node.values[left_out + 1 :]
            yield kept[0] if len(kept) == 1 else ast.BoolOp(node.op, kept)
    elif isinstance(node, ast.UnaryOp):
        yield node.operand
    elif isinstance(node, ast.BinOp):
        yield ast.BinOp(node.left, ARITHMETIC[type(node.op)](), node.right)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in FUNCTIONS:
        yield ast.Call(ast.Name(FUNCTIONS[node.func.id], ast.Load()), node.args, node.keywords)
    elif isinstance(node, ast.Constant):
        yield from map(ast.Constant, _numbers(node.value))
    elif isinstance(node, ast.ExceptHandler):
        yield from _handlers(node)
    elif isinstance(node, STATEMENTS):
        yield from _statements(parent, node)


def _numbers(value: object) -> tuple[object, ...]:
    if isinstance(value, bool):
        return (not value,)
    if isinstance(value, int):
        return (value + 1, value - 1)
    if isinstance(value, float):
        return (float(f"{value * 1.1:.6g}"), float(f"{value * 0.9:.6g}")) if value else (1.0,)
    return ()


def _handlers(node: ast.ExceptHandler) -> Iterator[ast.AST]:
    """The handler raises the exception again, or does not catch one of its exceptions."""
    yield ast.ExceptHandler(node.type, node.name, [ast.Raise()])
    if isinstance(node.type, ast.Tuple):
        for left_out in range(len(node.type.elts)):
            kept = node.type.elts[:left_out] + node.type.elts[left_out + 1 :]
            yield ast.ExceptHandler(ast.Tuple(kept, ast.Load()), node.name, node.body)


def _statements(parent: ast.AST, node: ast.AST) -> Iterator[ast.AST]:
    """The statement left out, or returning None. Those of modules and classes are declarations, which stay."""
    if isinstance(parent, (ast.Module, ast.ClassDef)):
        return
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        return  # a docstring, or ...
    if isinstance(node, ast.AnnAssign) and node.value is None:
        return
    if isinstance(node, ast.AugAssign):
        yield ast.AugAssign(node.target, ARITHMETIC[type(node.op)](), node.value)
    if not isinstance(node, ast.Return) or node.value is None:
        yield ast.Pass()
    elif not (isinstance(node.value, ast.Constant) and node.value.value is None):
        yield ast.Return(ast.Constant(None))
