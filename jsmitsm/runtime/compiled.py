"""Compiled programs, kept under what they compute; and small results, under what they are computed from."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from jsmitsm.runtime.jaxprs import ClosedJaxpr, Jaxpr, Literal, derivative


class Same:
    """Equal only to itself; keeps the object, so that its identity is not given away."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Same) and other.value is self.value

    def __hash__(self) -> int:
        return id(self.value)


class _Store:
    """What was made under a key, the longest unused dropped."""

    def __init__(self, most: int):
        self.most, self.made, self.lock = most, OrderedDict[Any, Any](), threading.Lock()  # solves run in threads too

    def __call__(self, key: Any, make: Callable[[], Any]) -> Any:
        with self.lock:
            found = self.made.get(key)
            if found is not None:
                self.made.move_to_end(key)
                return found
        made = make()
        with self.lock:
            self.made[key] = made
            if len(self.made) > self.most:
                self.made.popitem(last=False)
        return made


kept = _Store(256)  # programs
_programs = kept.made
remembered = _Store(64)  # results of at most a megabyte or so


def at_hand(known: set[int], least: int, most: float, default: int) -> int:
    """The smallest known size from ``least`` to ``most``, of which a program is compiled, or else ``default``."""
    size = min((s for s in tuple(known) if least <= s <= most), default=default)
    known.add(size)
    return size


def fingerprint(jaxpr: Any, rules: bool = True) -> Any:
    """A hashable value, equal for jaxprs that compute the same in the same way.

    ``rules``: a function with a derivative rule of its own is told apart by what the rule computes too.
    """
    number: dict[Any, int] = {}

    def name(v: Any) -> Any:
        if isinstance(v, Literal):
            aval: Any = v.aval
            value = np.asarray(v.val, aval.dtype)
            return value.dtype.str, value.tobytes()
        return number.setdefault(v, len(number))

    def declare(variables: Any) -> Any:
        return tuple((name(v), v.aval.shape, v.aval.dtype.name) for v in variables)

    head = declare(jaxpr.constvars), declare(jaxpr.invars)
    body = tuple(
        (
            eqn.primitive.name, tuple(map(name, eqn.invars)), declare(eqn.outvars), _parameters(eqn.params),
            _rule(eqn, rules),
        )
        for eqn in jaxpr.eqns
    )  # fmt: skip
    return head, body, tuple(map(name, jaxpr.outvars))


def _rule(eqn: Any, rules: bool) -> Any:
    """What the derivative rule of a custom_jvp function computes; rules inside rules go by their name."""
    if eqn.primitive.name != "custom_jvp_call" or not rules:
        return None
    active = tuple(k for k, v in enumerate(eqn.invars) if np.issubdtype(v.aval.dtype, np.inexact))
    jaxpr, consts = derivative(eqn, active)
    return fingerprint(jaxpr, False), tuple(map(_parameters, consts))


def _parameters(value: Any) -> Any:
    if isinstance(value, ClosedJaxpr):
        return fingerprint(value.jaxpr), tuple(map(_parameters, value.consts))
    if isinstance(value, Jaxpr):
        return fingerprint(value)
    if isinstance(value, dict):
        return tuple((k, _parameters(value[k])) for k in sorted(value))
    if isinstance(value, tuple | list):
        return tuple(map(_parameters, value))
    if isinstance(value, jax.core.Tracer):
        return object()  # like no other; its number may be given away
    if isinstance(value, np.ndarray | jax.Array):
        value = np.asarray(value)
        return value.dtype.str, value.shape, value.tobytes()
    source = getattr(getattr(value, "debug_info", None), "func_src_info", None)
    if source is not None:  # a derivative rule, wrapped anew at every trace
        return source
    try:
        hash(value)
    except TypeError:
        return repr(value)
    return value
