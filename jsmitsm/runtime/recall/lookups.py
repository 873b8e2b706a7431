"""What a function's code looks up beyond its own variables, read off its bytecode."""

from __future__ import annotations

import dis
import types
from functools import lru_cache
from typing import NamedTuple

# These bring in what no name in the code tells of, or change what others see.
_OPAQUE = frozenset({
    "IMPORT_NAME", "IMPORT_STAR", "LOAD_BUILD_CLASS", "STORE_GLOBAL", "DELETE_GLOBAL", "LOAD_LOCALS", "LOAD_NAME",
    "LOAD_CLASSDEREF", "LOAD_FROM_DICT_OR_DEREF", "LOAD_FROM_DICT_OR_GLOBALS", "LOAD_SUPER_ATTR", "DELETE_DEREF",
})  # fmt: skip
_ATTRIBUTES = frozenset({"LOAD_ATTR", "LOAD_METHOD", "STORE_ATTR", "DELETE_ATTR"})
_CLOSURE = frozenset({"LOAD_DEREF", "STORE_DEREF"})
# Attributes that lead from a number, a text or a function to what is not seen here: frames, the array behind a view,
# the owner of memory, and lookups by the words of a text.
_LEADING_ON = frozenset({
    "base", "data", "flags", "ctypes", "format", "format_map", "f_back", "f_builtins", "f_globals", "f_locals",
    "gi_frame", "gi_yieldfrom", "cr_frame", "ag_frame", "tb_frame", "mro",
})  # fmt: skip
_NOTHING = frozenset({"CACHE", "EXTENDED_ARG", "NOP", "PUSH_NULL"})


class Lookups(NamedTuple):
    """Per name, the chains of attributes that are read of it: m.a.b + m gives {("a", "b"), ()}."""

    names: tuple[str, ...]
    globals: dict[str, frozenset[tuple[str, ...]]]
    closure: dict[str, frozenset[tuple[str, ...]]]


@lru_cache(maxsize=1024)
def lookups(code: types.CodeType) -> Lookups | None:
    """The lookups of a code and of the functions inside of it; None where it may look up what is not named."""
    named: tuple[dict[str, set[tuple[str, ...]]], dict[str, set[tuple[str, ...]]]] = ({}, {})
    if not _collect(code, code.co_freevars, *named):
        return None
    names, closure = ({k: frozenset(v) for k, v in found.items()} for found in named)
    return Lookups(tuple(sorted(names)), names, closure)


def _collect(code: types.CodeType, outer: tuple[str, ...], names: dict, closure: dict) -> bool:
    operations = [op for op in dis.get_instructions(code) if op.opname not in _NOTHING]
    for k, op in enumerate(operations):
        if op.opname in _OPAQUE or (op.opname == "STORE_DEREF" and op.argval in outer):
            return False
        if op.opname in _ATTRIBUTES and (op.argval.startswith("__") or op.argval in _LEADING_ON):
            return False
        if op.opname == "LOAD_GLOBAL" or op.opname in _CLOSURE:
            found = names if op.opname == "LOAD_GLOBAL" else closure
            found.setdefault(op.argval, set()).add(_chain(operations[k + 1 :]))
    inner = [c for c in code.co_consts if isinstance(c, types.CodeType)]
    return all(_collect(c, outer, names, closure) for c in inner)


def _chain(operations: list[dis.Instruction]) -> tuple[str, ...]:
    """The attributes that are read one of the other."""
    read = []
    for op in operations:
        if op.opname not in ("LOAD_ATTR", "LOAD_METHOD"):
            break
        read.append(op.argval)
    return tuple(read)
