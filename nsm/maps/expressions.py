"""Expressions in u and v given as text, and their derivatives by dual numbers."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable

import torch
from torch import Tensor

from nsm.errors import NsmError

Triple = tuple[Tensor, Tensor, Tensor]
# A part of an expression, evaluated: a constant, or value, d/du and d/dv (a dual number).
Dual = float | Triple

_LARGEST_CONSTANT = 1e30  # beside tensors, so that float32 can hold it
_LONGEST_EXPRESSION = 500  # characters
_DEEPEST_EXPRESSION = 200  # levels; evaluation takes a stack frame for each
_CONSTANTS = {"pi": math.pi}
_OPERATORS: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: math.pow,
}
# name -> (on constants, on tensors, derivative from the argument and the value)
_FUNCTIONS: dict[
    str,
    tuple[
        Callable[[float], float],
        Callable[[Tensor], Tensor],
        Callable[[Tensor, Tensor], Tensor],
    ],
] = {
    "sin": (math.sin, torch.sin, lambda x, y: x.cos()),
    "cos": (math.cos, torch.cos, lambda x, y: -x.sin()),
    "tan": (math.tan, torch.tan, lambda x, y: 1 + y * y),
    "exp": (math.exp, torch.exp, lambda x, y: y),
    "log": (math.log, torch.log, lambda x, y: 1 / x),
    "sqrt": (math.sqrt, torch.sqrt, lambda x, y: 0.5 / y),
    "tanh": (math.tanh, torch.tanh, lambda x, y: 1 - y * y),
    "sinh": (math.sinh, torch.sinh, lambda x, y: x.cosh()),
    "cosh": (math.cosh, torch.cosh, lambda x, y: x.sinh()),
    "abs": (abs, torch.abs, lambda x, y: x.sign()),
}


def parse_expression(text: str) -> ast.expr:
    """The syntax tree of an expression in u and v, every node of it known to be harmless.

    Allowed: numbers, ``u``, ``v``, ``pi``, ``+ - * / **``, signs, parentheses, and ``sin cos tan
    exp log sqrt tanh sinh cosh abs`` of one argument. Nothing is ever executed as Python.

    Raises:
        NsmError: the text is no such expression.
    """
    shown = repr(text if len(text) <= 60 else text[:57] + "...")
    if len(text) > _LONGEST_EXPRESSION:
        raise NsmError(f"graph {shown}: longer than {_LONGEST_EXPRESSION} characters")
    try:
        tree = ast.parse(text.strip(), mode="eval").body
        _check_node(tree)
    except NsmError as error:
        raise NsmError(f"graph {shown}: {error}") from None
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        raise NsmError(f"graph {shown}: not an expression in u and v") from None
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


def value_and_slopes(tree: ast.expr, u: Tensor, v: Tensor) -> Triple:
    """A parsed expression's value, and its derivatives by u and by v, at u (N,) and v (N,).

    Raises:
        ArithmeticError, ValueError: a constant part is not finite, or is too large.
    """
    return _lift(_evaluate(tree, u, v), u)


def _evaluate(node: ast.expr, u: Tensor, v: Tensor) -> Dual:
    """The dual number of a checked tree; parts without u and v stay plain floats."""
    if isinstance(node, ast.Constant):
        return float(node.value)  # type: ignore[arg-type]
    if isinstance(node, ast.Name):
        if node.id in _CONSTANTS:
            return _CONSTANTS[node.id]
        one, zero = torch.ones_like(u), torch.zeros_like(u)
        return (u, one, zero) if node.id == "u" else (v, zero, one)
    if isinstance(node, ast.UnaryOp):
        operand = _evaluate(node.operand, u, v)
        return operand if isinstance(node.op, ast.UAdd) else _combine(ast.Mult, -1.0, operand)
    if isinstance(node, ast.BinOp):
        return _combine(type(node.op), _evaluate(node.left, u, v), _evaluate(node.right, u, v))
    assert isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    return _apply(node.func.id, _evaluate(node.args[0], u, v))


def _apply(function: str, argument: Dual) -> Dual:
    on_constants, on_tensors, slope_of = _FUNCTIONS[function]
    if isinstance(argument, float):
        return float(on_constants(argument))
    x, x_u, x_v = argument
    y = on_tensors(x)
    slope = slope_of(x, y)
    return y, slope * x_u, slope * x_v


def _combine(kind: type[ast.operator], left: Dual, right: Dual) -> Dual:
    if isinstance(left, float) and isinstance(right, float):
        return _OPERATORS[kind](left, right)
    if kind is ast.Pow:
        return _power(left, right)
    like = next(x[0] for x in (left, right) if not isinstance(x, float))
    a, a_u, a_v = _lift(left, like)
    b, b_u, b_v = _lift(right, like)
    if kind is ast.Add:
        return a + b, a_u + b_u, a_v + b_v
    if kind is ast.Sub:
        return a - b, a_u - b_u, a_v - b_v
    if kind is ast.Mult:
        return a * b, a_u * b + a * b_u, a_v * b + a * b_v
    quotient = a / b
    return quotient, (a_u - quotient * b_u) / b, (a_v - quotient * b_v) / b


def _power(base: Dual, exponent: Dual) -> Dual:
    if isinstance(exponent, float):
        assert not isinstance(base, float)
        if exponent == 0:
            return 1.0
        _check_constant(exponent)
        x, x_u, x_v = base
        slope = exponent * x ** (exponent - 1)
        return x**exponent, slope * x_u, slope * x_v
    # a^b = exp(b log a): the base must be positive, as for real powers it must
    y, y_u, y_v = _lift(base, exponent[0])
    logarithm = _apply("log", (y, y_u, y_v))
    return _apply("exp", _combine(ast.Mult, exponent, logarithm))


def _check_constant(x: float) -> None:
    if not abs(x) <= _LARGEST_CONSTANT:
        raise OverflowError


def _lift(x: Dual, like: Tensor) -> Triple:
    if isinstance(x, float):
        _check_constant(x)
        zero = torch.zeros_like(like)
        return torch.full_like(like, x), zero, zero
    return x
