"""The kinds of mistake that `make mutants` puts into a file: operators of cosmic-ray, and five of ours.

Operators of cosmic-ray that no reviewer would choose (`+` to `<<`) are left out, because every test notices them and
they would fill the sample. `<` to `<=` is left out because it changes nothing where two measured floats are compared.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import parso
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator

_OF_COSMIC_RAY = (
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul")),
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("Mod_Mul", "Pow_Mul", "BitAnd_BitOr", "BitOr_BitAnd")),
    *(f"ReplaceBinaryOperator_{pair}" for pair in ("RShift_LShift", "LShift_RShift")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("Lt_Gt", "Gt_Lt", "LtE_GtE", "GtE_LtE")),
    *(f"ReplaceComparisonOperator_{pair}" for pair in ("Eq_NotEq", "NotEq_Eq", "Is_IsNot", "IsNot_Is")),
    *(f"ReplaceUnaryOperator_Delete_{name}" for name in ("USub", "Not", "Invert")),
    *("AddNot", "ReplaceAndWithOr", "ReplaceOrWithAnd", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue"),
    *("ZeroIterationForLoop", "ReplaceBreakWithContinue", "ReplaceContinueWithBreak"),
)
_LIMITING = ("abs", "max", "min")
"""Functions whose result is often one of their arguments."""
_UNORDERED = ("max", "min", "isinstance", "hypot", "in")
"""Names before arguments and tuples that are not swapped: it changes nothing, or every test notices it."""


class _Replace(Operator):
    """Replace a node by texts made of it."""

    def texts(self, node: Any) -> Iterator[str]:
        """Yield what can stand in the place of the node."""
        raise NotImplementedError

    def mutation_positions(self, node: Any) -> Iterator[tuple[Any, Any]]:
        """Yield the node's position once for each text."""
        for _ in self.texts(node):
            yield node.start_pos, node.end_pos

    def mutate(self, node: Any, index: int) -> Any:
        """Return the text with the white space before the node."""
        return parso.parse(node.get_first_leaf().prefix + list(self.texts(node))[index])

    @classmethod
    def examples(cls) -> Iterable[Any]:
        """Return no examples."""
        return ()


class OtherNumber(_Replace):
    """Replace an integer by the next one, and a float by its double."""

    def texts(self, node: Any) -> Iterator[str]:
        """Yield the other number."""
        if node.type == "number":
            value = ast.literal_eval(node.value)
            yield repr(value + 1 if isinstance(value, int) else 2.0 * value or 1.0)


class LeaveOutStatement(_Replace):
    """Leave out an assignment to an attribute or an element, or a call whose result is not used."""

    def texts(self, node: Any) -> Iterator[str]:
        """Yield `pass`, but not in `__init__`, where every test would notice it."""
        function = node.search_ancestor("funcdef")
        if node.parent is None or node.parent.type != "simple_stmt" or function is None:
            return
        first, second = (*getattr(node, "children", ()), None, None)[:2]
        is_assignment = node.type == "expr_stmt" and (
            first.type in _CHAINS or (second.type == "operator" and second.value != "=")
        )
        is_call = node.type in _CHAINS and node.children[-1].get_code().startswith("(")
        if function.name.value != "__init__" and (is_assignment or is_call):
            yield "pass"


class LeaveOutOperand(_Replace):
    """Leave out the first or the last operand of a condition, the last of a sum or a product."""

    def texts(self, node: Any) -> Iterator[str]:
        """Yield what remains."""
        if node.type in ("arith_expr", "term", "and_test", "or_test"):
            yield "".join(child.get_code() for child in node.children[:-2]).strip()
        if node.type in ("and_test", "or_test"):
            yield "".join(child.get_code() for child in node.children[2:]).strip()


class LeaveOutLimit(_Replace):
    """Take an argument of `abs`, `max` or `min` in the place of the result."""

    def texts(self, node: Any) -> Iterator[str]:
        """Yield the first and the last argument."""
        if node.type in _CHAINS and len(node.children) == 2 and node.children[0].get_code().strip() in _LIMITING:
            arguments = _arguments(node.children[1].children[1])
            if all(argument.type not in ("argument", "operator") for argument in arguments):
                yield from dict.fromkeys(f"({arguments[i].get_code().strip()})" for i in (0, -1))


class SwapArguments(_Replace):
    """Swap two neighbouring arguments of a call, or neighbours in a tuple."""

    def texts(self, node: Any) -> Iterator[str]:
        """Yield the list with two neighbours swapped, for all neighbours."""
        if node.type not in ("arglist", "testlist_comp") or node.search_ancestor("funcdef") is None:
            return
        before = node.parent.get_previous_sibling()
        if before is not None and before.get_code().split()[-1] in _UNORDERED:
            return
        parts = [part.get_code().strip() for part in _arguments(node)]
        for i, (a, b) in enumerate(zip(_arguments(node), _arguments(node)[1:], strict=False)):
            if "argument" not in (a.type, b.type) and "comp_for" not in b.type and parts[i] != parts[i + 1]:
                yield ", ".join([*parts[:i], parts[i + 1], parts[i], *parts[i + 2 :]])


_CHAINS = ("atom_expr", "power")
"""How parso calls a name with attributes, indices and calls."""


def _arguments(node: Any) -> list[Any]:
    """Return the arguments of a call, or the elements of a tuple."""
    return node.children[::2] if node.type in ("arglist", "testlist_comp") else [node]


_OPERATORS: tuple[Operator, ...] = (
    *(get_operator(f"core/{name}")() for name in _OF_COSMIC_RAY),
    *(OtherNumber(), LeaveOutStatement(), LeaveOutOperand(), LeaveOutLimit(), SwapArguments()),
)


class Mutant(NamedTuple):
    """One mistake in one file."""

    path: str
    line: int
    operator: Operator
    occurrence: int

    def code(self, source: str) -> str:
        """Return the file with the mistake."""
        mutated: str = mutate_code(source, self.operator, self.occurrence)
        return mutated


def _unseen(source: str) -> Iterator[ast.expr]:
    """Yield annotations, and the texts of messages: tests are not meant to notice a change of them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.arg | ast.AnnAssign) and node.annotation is not None:
            yield node.annotation
        elif isinstance(node, ast.FunctionDef) and node.returns is not None:
            yield node.returns
        elif isinstance(node, ast.JoinedStr):
            yield node


def mutants_of(path: str, source: str) -> Iterator[Mutant]:
    """Yield every mistake that can be put into the file."""
    ranges = [((part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)) for part in _unseen(source)]
    nodes = list(ast_nodes(get_ast(source)))
    for operator in _OPERATORS:
        positions = (start for node in nodes for start, _ in operator.mutation_positions(node))
        for occurrence, start in enumerate(positions):
            if not any(begin <= start < end for begin, end in ranges):
                yield Mutant(path, start[0], operator, occurrence)
