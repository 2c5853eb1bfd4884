"""Expressions in u and v given as text."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from nsm.errors import NsmError

_LARGEST_CONSTANT = 1e30  # beside tensors, so that float32 can hold it
_LONGEST_EXPRESSION = 500  # characters
_DEEPEST_EXPRESSION = 200  # levels; evaluation takes a stack frame for each
_CONSTANTS = {"pi": math.pi}
_OPERATORS: dict[type[ast.operator], Callable[[Any, Any], Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,
}
_FUNCTIONS: dict[str, tuple[Callable[[float], float], Callable[[Tensor], Tensor]]] = {
    name: (getattr(math, name), getattr(torch, name))
    for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "tanh", "sinh", "cosh")
}
_FUNCTIONS["abs"] = abs, torch.abs


def parse_expression(text: str) -> ast.expr:
    """The syntax tree of an expression in u and v, every node of it known to be harmless.

    Allowed: numbers, ``u``, ``v``, ``pi``, ``+ - * / **``, signs, parentheses, and ``sin cos tan
    exp log sqrt tanh sinh cosh abs`` of one argument. Nothing is ever executed as Python.

    Raises:
        NsmError: the text is no such expression.
    """
    shown = repr(text if len(text) <= 60 else text[:57] + "...")
    if len(text) > _LONGEST_EXPRESSION:
        message = f"graph {shown}: longer than {_LONGEST_EXPRESSION} characters"
        raise NsmError(message, kind="invalid_expression", key="z")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        _check_node(tree)
    except NsmError as error:
        raise NsmError(f"graph {shown}: {error}", kind="invalid_expression", key="z") from None
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        message = f"graph {shown}: not an expression in u and v"
        raise NsmError(message, kind="invalid_expression", key="z") from None
    return tree


def _check_node(node: ast.AST, depth: int = 0) -> None:
    if depth > _DEEPEST_EXPRESSION:
        raise NsmError("nested too deeply")
    children: list[ast.expr] = []
    if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
        children = [node.left, node.right]
    elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitXor):
        raise NsmError("powers are written **, not ^")
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        children = [node.operand]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
        if node.func.id not in _FUNCTIONS:
            raise NsmError(f"{node.func.id!r} is not one of {', '.join(_FUNCTIONS)}")
        if len(node.args) != 1 or node.keywords:
            raise NsmError(f"{node.func.id} takes one argument")
        children = node.args
    elif isinstance(node, ast.Name):
        if node.id not in ("u", "v", *_CONSTANTS):
            raise NsmError(f"{node.id!r} is not one of u, v, {', '.join(_CONSTANTS)}")
    elif not (isinstance(node, ast.Constant) and type(node.value) in (int, float)):
        raise NsmError(f"{ast.unparse(node)!r} is not allowed".replace("\n", " "))
    for child in children:
        _check_node(child, depth + 1)


def evaluate(tree: ast.expr, u: Tensor, v: Tensor) -> Tensor:
    """A parsed expression at u (N,) and v (N,).

    Raises:
        ArithmeticError, ValueError: a constant part is not finite, or is too large.
    """
    z = _evaluate(tree, u, v)
    return torch.full_like(u, _constant(z)) if isinstance(z, float) else z


def _evaluate(node: ast.expr, u: Tensor, v: Tensor) -> float | Tensor:
    """The value of a checked tree; parts without u and v stay plain floats."""
    if isinstance(node, ast.Constant):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        return _CONSTANTS[node.id] if node.id in _CONSTANTS else {"u": u, "v": v}[node.id]
    if isinstance(node, ast.UnaryOp):
        operand = _evaluate(node.operand, u, v)
        return operand if isinstance(node.op, ast.UAdd) else -operand
    if isinstance(node, ast.BinOp):
        operate, both = _OPERATORS[type(node.op)], (node.left, node.right)
        left, right = (_evaluate(part, u, v) for part in both)
        if isinstance(left, float) and isinstance(right, float):
            return operate(left, right)
        left, right = (_constant(x) if isinstance(x, float) else x for x in (left, right))
        if operate is not math.pow:
            return operate(left, right)
        if isinstance(right, float):
            return left**right
        # a^b = exp(b log a): the base must be positive, as for real powers it must
        return torch.exp(right * torch.log(torch.as_tensor(left, dtype=u.dtype, device=u.device)))
    assert isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    argument = _evaluate(node.args[0], u, v)
    on_constants, on_tensors = _FUNCTIONS[node.func.id]
    if isinstance(argument, float):
        return float(on_constants(argument))
    return on_tensors(argument)


def _constant(x: float) -> float:
    """A constant that stands beside tensors."""
    if not abs(x) <= _LARGEST_CONSTANT:
        raise OverflowError
    return x
