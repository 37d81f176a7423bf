"""Mutants of a Python source: one small change each, by the operators of cosmic-ray, without those that say nothing.

cosmic-ray replaces every binary operator by eleven others and every comparison by seven; most of them raise at once.
One partner of each operator is kept, and of each comparison the nearest (its boundary) and the opposite; a sign is
taken away. Annotations of functions are left alone, since nothing evaluates them.
"""

from __future__ import annotations

import ast
import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import CodeType

import cosmic_ray.plugins
import parso
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator

BINARY = {"Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_Mul", "Pow_Mul"} | {
    f"{one}_{other}" for one, other in (("BitOr", "BitAnd"), ("BitAnd", "BitOr"), ("BitXor", "BitAnd"))
}
COMPARISONS = {
    *("Lt_LtE", "Lt_GtE", "LtE_Lt", "LtE_Gt", "Gt_GtE", "Gt_LtE", "GtE_Gt", "GtE_Lt"),
    *("Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is"),
}
UNARY = {"Delete_Not", "Delete_USub", "Delete_Invert"}
# What is kept of these families; every other operator of cosmic-ray is used as it is.
CHOSEN = {"ReplaceBinaryOperator": BINARY, "ReplaceComparisonOperator": COMPARISONS, "ReplaceUnaryOperator": UNARY}
# Below these decorators the function stays what it is.
TRANSPARENT = {"property", "classmethod", "staticmethod"}


@dataclass(frozen=True)
class Mutant:
    """One changed source.

    Arguments:
        operator: Its name in cosmic-ray, without the plugin's.
        line: Where the change is, from 1.
        before, after: The changed line, stripped; `after` is empty where the line is gone.
        code: The whole changed source.
    """

    operator: str
    line: int
    before: str
    after: str
    code: str


def mutants_of(source: str) -> list[Mutant]:
    """Every mutant of a source that compiles, by line."""
    lines = source.splitlines(keepends=True)
    starts = [*(_first_line(node) - 1 for node in ast.parse(source).body), len(lines)]
    found = []
    # statement by statement: every mutant is parsed anew
    for start, end in itertools.pairwise(starts):
        before, part, after = ("".join(lines[one]) for one in (slice(start), slice(start, end), slice(end, None)))
        for mutant in _of_part(part):
            code, line = before + mutant.code + after, mutant.line + start
            found.append(replace(mutant, code=code, line=line))
    distinct = {mutant.code: mutant for mutant in found}
    return sorted(distinct.values(), key=lambda mutant: (mutant.line, mutant.operator, mutant.after))


def _first_line(node: ast.stmt) -> int:
    return min([node.lineno, *(one.lineno for one in getattr(node, "decorator_list", []))])


def function_bodies(source: str) -> dict[str, tuple[int, int]]:
    """First and last line of what each function or method does, by its dotted name; not of what decorators replace."""
    found = {}

    def look(nodes: list[ast.stmt], path: tuple[str, ...]) -> None:
        for node in nodes:
            if isinstance(node, ast.ClassDef):
                look(node.body, (*path, node.name))
            elif isinstance(node, ast.FunctionDef) and {ast.unparse(one) for one in node.decorator_list} <= TRANSPARENT:
                found[".".join((*path, node.name))] = (node.body[0].lineno, node.end_lineno or node.body[-1].lineno)

    look(ast.parse(source).body, ())
    return found


def function_code(code: CodeType, name: str) -> CodeType:
    """The compiled function of a dotted name inside a compiled module."""
    for part in name.split("."):
        code = next(one for one in code.co_consts if isinstance(one, CodeType) and one.co_name == part)
    return code


def _of_part(source: str) -> Iterator[Mutant]:
    tree = get_ast(source)
    nodes, unread = list(ast_nodes(tree)), _annotations(tree)
    for name, operator in _operators():
        places = [place for node in nodes for place in operator.mutation_positions(node)]
        for occurrence, (start, _) in enumerate(places):
            if any(low <= start < high for low, high in unread):
                continue
            code = mutate_code(source, operator, occurrence)
            if code is not None and code != source and _compiles(code):
                yield _described(source, code, name, start[0])


@functools.cache
def _operators() -> tuple[tuple[str, Operator], ...]:
    """The operators that are used, by name."""
    found = []
    for name in sorted(cosmic_ray.plugins.operator_names()):
        kind, short = cosmic_ray.plugins.get_operator(name), name.partition("/")[2]
        family, _, pair = short.partition("_")
        # the variable operators take arguments, and there is no default for them
        if not kind.arguments() and (family not in CHOSEN or pair in CHOSEN[family]):
            found.append((short, kind()))
    return tuple(found)


def _annotations(tree: parso.tree.NodeOrLeaf) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """From where to where the annotations of functions and the stars between their parameters reach."""
    nodes = list(ast_nodes(tree))
    noted = [node.annotation for node in nodes if node.type in ("param", "funcdef") and node.annotation is not None]
    stars = [node for node in nodes if node.type == "operator" and node.parent.type == "parameters"]
    return [(node.start_pos, node.end_pos) for node in (*noted, *stars)]


def _compiles(code: str) -> bool:
    try:
        compile(code, "mutant", "exec")
    except SyntaxError:
        return False
    return True


def _described(source: str, code: str, operator: str, line: int) -> Mutant:
    old, new = source.splitlines(), code.splitlines()
    after = new[line - 1].strip() if len(new) == len(old) else ""
    return Mutant(operator, line, old[line - 1].strip(), after, code)
