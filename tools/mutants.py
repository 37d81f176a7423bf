"""Mutants of a Python source: one small change each, by the operators of cosmic-ray, without those that say nothing.

cosmic-ray replaces every binary operator by eleven others and every comparison by seven; most of them raise at once.
One partner of each operator is kept, and of each comparison the nearest (its boundary) and the opposite; a sign is
taken away. Annotations of functions are left alone, since nothing evaluates them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from types import CodeType

import cosmic_ray.plugins
import parso
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code

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
    found = [mutant for name in sorted(cosmic_ray.plugins.operator_names()) for mutant in _by_operator(source, name)]
    distinct = {mutant.code: mutant for mutant in found}
    return sorted(distinct.values(), key=lambda mutant: (mutant.line, mutant.operator, mutant.after))


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


def _by_operator(source: str, name: str) -> Iterator[Mutant]:
    operator_class, short = cosmic_ray.plugins.get_operator(name), name.partition("/")[2]
    family, _, pair = short.partition("_")
    # the variable operators take arguments, and there is no default for them
    if operator_class.arguments() or (family in CHOSEN and pair not in CHOSEN[family]):
        return
    operator, tree = operator_class(), get_ast(source)
    unread = _annotations(tree)
    places = [place for node in ast_nodes(tree) for place in operator.mutation_positions(node)]
    for occurrence, (start, _) in enumerate(places):
        if any(low <= start < high for low, high in unread):
            continue
        code = mutate_code(source, operator, occurrence)
        if code is not None and code != source and _compiles(code):
            yield _described(source, code, short, start[0])


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
