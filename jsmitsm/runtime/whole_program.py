"""Programs that stay whole, and keep their compiler options, under an eager jax.grad, jvp or vmap.

A jitted function that is differentiated does neither: JAX splits it into programs of its own, compiles each with full
effort, and refuses options of a program that may come to stand in a larger one. So a program is a primitive here. With
f its function of x, its transformations are programs again, compiled by the same options:

    jvp         f(x)  and  moved: (x, dx) -> f'(x) dx
    transpose   pulled: (known arguments, y_bar) -> x_bar, for an f that is linear in the arguments x
    vmap        mapped: f along an axis

Nothing but x is kept between them: what f computes on the way is computed again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextvars import ContextVar
from functools import lru_cache, wraps
from inspect import signature
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import ad, batching, mlir

from jsmitsm.runtime import one_kernel
from jsmitsm.runtime.collector import uncollected
from jsmitsm.runtime.compiler_options import on_cpu
from jsmitsm.runtime.jaxprs import Literal, Primitive, jaxpr_as_fun
from jsmitsm.runtime.size_classes import BLOCK, largest_at_hand
from jsmitsm.runtime.threads import cores, side_by_side
from jsmitsm.runtime.tracers import is_traced, recorded

# Options as pairs; None: f runs as it stands, in numpy, and its derivatives are compiled with little effort. With the
# least they would be compiled in half the time, but what is computed twice differs by rounding there: the slope of a
# maximum, which looks for the entry that equals it, was zero now and then.
Options = tuple[tuple[str, Any], ...] | None
_LITTLE: Any = {"xla_cpu_use_fusion_emitters": False, "xla_backend_optimization_level": 1}
_KEPT = 1024
# Rows that are worth a core of their own.
_WORTH = 1000
COUNT, WEIGHTS = "how many of the rows are wanted", "rows that weigh others"


_only_run: ContextVar[bool] = ContextVar("a program that is only run", default=False)


def only_run() -> bool:
    """Whether no derivative will be taken of what is traced here: how often a loop runs may be a number of its own.

    Only the programs that run are traced so; ``part``, of which derivatives are made, is not.
    """
    return _only_run.get()


def _to_be_run(function: Callable[..., Any]) -> Callable[..., Any]:
    @wraps(function)
    def run(*arguments: Any) -> Any:
        before = _only_run.set(True)
        try:
            return function(*arguments)
        finally:
            _only_run.reset(before)

    return run


def called(
    function: Callable[..., Any], static: dict[str, Any], arguments: dict[str, Any], options: Options,
    small: bool = False, rows: Any = None,
) -> Any:  # fmt: skip
    """``function(**static, **arguments)`` as one program; not for calls inside of a larger one.

    ``small``: its arrays are so small that one kernel should do it all. ``rows``: a tree like the arguments that says
    which of them, ``True``, have a row for each row of every result and for nothing else: under a transformation the
    cores share the rows. ``COUNT`` stands for the number of rows that are wanted.
    """
    leaves, tree = jax.tree.flatten(arguments)
    by_row = None if rows is None else tuple(jax.tree.leaves(rows))
    program = _whole(function, tuple(static.items()), tree, options, small, by_row)
    if not is_traced(leaves):
        return program.run(*leaves)
    return jax.tree.unflatten(program.result(_avals(leaves)).tree, program_p.bind(*leaves, program=program))


def in_one_program(function: Callable[..., Any], static: tuple[str, ...] = ()) -> Callable[..., Any]:
    """``function`` as it stands, for numbers; as a whole where an argument of it is traced.

    Under an eager jax.grad or jax.vmap each operation is otherwise a program of its own, compiled for every
    shape, and so is what differentiates it: a hundred of them take ten times as long as the local phase.
    """
    compiled, parameters = jax.jit(function, static_argnames=static), signature(function)

    @wraps(function)
    def run(*arguments: Any, **named: Any) -> Any:
        if not is_traced(arguments, named):
            return function(*arguments, **named)
        if recorded():
            return compiled(*arguments, **named)
        given = parameters.bind(*arguments, **named).arguments
        return called(function, {k: given.pop(k) for k in static}, dict(given), None)

    return run


picked = in_one_program(lambda values, index: values[index])


class Share(NamedTuple):
    """The arguments of one core, and how many rows they have; ``wanted`` of these belong to the whole."""

    arguments: list[Any]
    rows: int
    wanted: int


class Rows(NamedTuple):
    """How the rows of a program's arguments are shared among the cores.

    arguments: of each one whether it has such rows, or WEIGHTS where they weigh the others, or COUNT where it is their
    number; summed: of each result whether the shares add up to it, as what is pulled back to an argument without rows;
    the others are put together again.
    """

    arguments: tuple[bool | str, ...]
    summed: tuple[bool, ...]

    def length(self, arguments: Sequence[Any]) -> int:
        return next(len(x) for x, flag in zip(arguments, self.arguments, strict=True) if flag is True)

    def others(self, arguments: Sequence[Any]) -> tuple[Any, ...]:
        """What a program is compiled for, but the number of rows."""
        kinds = zip(_avals(arguments), self.arguments, strict=True)
        return tuple((a.shape[1:] if flag is True else a.shape, a.dtype) for a, flag in kinds)

    def filled(self, arguments: Sequence[Any], more: int) -> list[Any]:
        """So many more rows, which nobody wants."""
        rows = [np.asarray(x) if flag is True else x for x, flag in zip(arguments, self.arguments, strict=True)]
        return [np.concatenate([x, np.broadcast_to(x[:1], (more, *x.shape[1:]))]) if flag is True else x
                for x, flag in zip(rows, self.arguments, strict=True)]  # fmt: skip

    def shares(self, arguments: Sequence[Any]) -> list[Share] | None:
        """Equal shares, the last one filled up by rows without weight; None where sharing does not pay."""
        n = self.length(arguments)
        size = -(-n // (cores() * BLOCK)) * BLOCK
        if cores() < 2 or size < _WORTH or jax.default_backend() != "cpu":
            return None
        return [self._share(arguments, slice(start, start + size), n, size) for start in range(0, n, size)]

    def _share(self, arguments: Sequence[Any], some: slice, n: int, size: int) -> Share:
        wanted = min(size, n - some.start)
        out = []
        for x, flag in zip(arguments, self.arguments, strict=True):
            if flag is True or flag == WEIGHTS:
                x = np.asarray(x)[some]
                if wanted < size:
                    x = np.concatenate([x, np.repeat(x[:1] * (flag is True), size - wanted, axis=0)])
            elif flag == COUNT:
                x = np.clip(np.asarray(x) - np.asarray(some.start, x.dtype), 0, size).astype(x.dtype)
            out.append(x)
        return Share(out, size, wanted)

    def together(self, parts: list[list[np.ndarray]], shares: list[Share]) -> list[np.ndarray]:
        """The results of the whole."""
        summed = self.summed or (False,) * len(parts[0])
        cut = [[x if add else x[: share.wanted] for x, add in zip(part, summed)] for part, share in zip(parts, shares)]
        return [sum(some) if add else np.concatenate(some) for some, add in zip(zip(*cut), summed)]


class Program:
    """A function of arrays; ``base``: not a derivative of another one."""

    def __init__(
        self, function: Callable[..., Any], name: str, options: Options, base: bool = False, small: bool = False,
        rows: Rows | None = None,
    ):  # fmt: skip
        self.rows = rows
        self.stops = base and rows is not None and COUNT in rows.arguments  # after the rows wanted
        self.lengths: dict[Any, set[int]] = {}  # in rows, of what is compiled, by all else
        self.name, self.options, self.on_host, self.small = name, options, base and options is None, small
        self.function, self.trace = function, jax.jit(function).trace
        self.results: dict[Any, Result] = {}

        def part(*arguments: Any) -> Any:
            """The function inside of other programs, traced once for all of them."""
            result = self.result(_avals(arguments))
            return jax.tree.unflatten(result.tree, jaxpr_as_fun(result.closed)(*arguments))

        part.__name__ = name
        if options is None:
            options = tuple(on_cpu(_LITTLE).items())
        function.__name__ = name
        if base:
            function = _to_be_run(function)
        self.part, self.compiled = part, jax.jit(function, compiler_options=dict(options))
        if small:
            self.kernel = jax.jit(one_kernel.one_kernel(function), compiler_options=dict(options) | one_kernel.OPTIONS)

    def run(self, *arguments: Any) -> Any:
        if self.on_host:
            return self.function(*map(np.asarray, arguments))
        if self.stops and self.rows is not None:
            self.lengths.setdefault(self.rows.others(arguments), set()).add(self.rows.length(arguments))
        with uncollected():
            return self._run(*arguments)

    def at_hand(self, arguments: Sequence[Any]) -> list[Any]:
        """The results, by what is compiled for more rows where that stops after those wanted."""
        if not self.stops or self.rows is None:
            return jax.tree.leaves(self.run(*arguments))
        n = self.rows.length(arguments)
        lengths = self.lengths.get(self.rows.others(arguments), ())
        size = min((s for s in lengths if n <= s <= largest_at_hand(n)), default=n)
        if size == n:
            return jax.tree.leaves(self.run(*arguments))
        out = jax.tree.leaves(self.run(*self.rows.filled(arguments, size - n)))
        return [jax.device_put(np.asarray(x)[:n]) for x in out]

    def _run(self, *arguments: Any) -> Any:
        config: Any = jax.config
        if config.jax_disable_jit:  # step by step: what a compiled program makes of numpy's arrays by itself
            return self.function(*map(jnp.asarray, arguments))
        if not self.small:
            return self.compiled(*arguments)
        try:
            return self.kernel(*arguments)[0]
        except jax.errors.JaxRuntimeError as error:
            if "UNIMPLEMENTED" not in str(error):
                raise
            self.small = False  # an operation that a kernel cannot hold
            return self.compiled(*arguments)

    def result(self, avals: tuple[Any, ...]) -> Result:
        config: Any = jax.config
        key = avals, config.jax_enable_x64  # a setting of the thread, and of the moment
        found = self.results.get(key)
        if found is None:
            found = self.results[key] = Result(self.trace(*avals))
        return found


class Result:
    """What is known of a program's results before it runs."""

    def __init__(self, traced: Any):
        leaves, self.tree = jax.tree.flatten(traced.out_info)
        self.avals = [jax.core.ShapedArray(x.shape, x.dtype) for x in leaves]
        self.closed = traced.jaxpr

    def reached(self, active: Sequence[int]) -> tuple[int, ...]:
        """Those that depend on the ``active`` arguments and are not whole numbers."""
        jaxpr = self.closed.jaxpr
        moving = {jaxpr.invars[k] for k in active}
        for eqn in jaxpr.eqns:
            if any(not isinstance(v, Literal) and v in moving for v in eqn.invars):
                moving.update(eqn.outvars)
        inexact = [jnp.issubdtype(x.dtype, jnp.inexact) for x in self.avals]
        return tuple(k for k, v in enumerate(jaxpr.outvars)
                     if inexact[k] and not isinstance(v, Literal) and v in moving)  # fmt: skip


def _avals(values: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(jax.typeof(x) for x in values)


def _with(values: Sequence[Any], places: Sequence[int], new: Sequence[Any]) -> list[Any]:
    out = list(values)
    for k, value in zip(places, new, strict=True):
        out[k] = value
    return out


# ------------------------------------------------------------------------------------- the four kinds


@lru_cache(maxsize=_KEPT)
def _whole(
    function: Callable[..., Any], static: tuple[tuple[str, Any], ...], tree: Any, options: Options, small: bool,
    by_row: tuple[bool | str, ...] | None = None,
) -> Program:  # fmt: skip
    """A function of the leaves of its arguments."""
    call = lambda *leaves: function(**dict(static), **jax.tree.unflatten(tree, leaves))  # noqa: E731
    rows = None if by_row is None else Rows(by_row, ())
    return Program(call, function.__name__, options, base=True, small=small, rows=rows)


@lru_cache(maxsize=_KEPT)
def _moved(program: Program, active: tuple[int, ...], reached: tuple[int, ...]) -> Program:
    """(x, tangents of the ``active`` arguments) -> tangents of the results ``reached``."""

    def moved(*arguments: Any) -> Any:
        split = len(arguments) - len(active)
        x, slopes = arguments[:split], arguments[split:]

        def some(*moving: Any) -> tuple[Any, ...]:
            out = jax.tree.leaves(program.part(*_with(x, active, moving)))
            return tuple(out[k] for k in reached)

        return jax.jvp(some, tuple(x[k] for k in active), slopes)[1]

    rows = None
    if program.rows is not None and not program.rows.summed:
        flags = program.rows.arguments
        rows = Rows((*flags, *(flags[k] for k in active)), ())
    return Program(moved, f"moved_{program.name}", program.options, rows=rows)


@lru_cache(maxsize=_KEPT)
def _pulled(program: Program, linear: tuple[int, ...], avals: tuple[Any, ...], given: tuple[int, ...]) -> Program:
    """(the other arguments, cotangents of the results ``given``) -> cotangents of the ``linear`` arguments."""

    def pulled(*arguments: Any) -> Any:
        split = len(arguments) - len(given)
        known, cotangents = arguments[:split], arguments[split:]
        count = split + len(linear)
        full = _with([None] * count, [k for k in range(count) if k not in linear], known)

        def some(*moving: Any) -> tuple[Any, ...]:
            out = jax.tree.leaves(program.part(*_with(full, linear, moving)))
            return tuple(out[k] for k in given)

        here = avals if rows is None else [_of_length(a, len(cotangents[0]), s) for a, s in zip(avals, rows.summed)]
        return jax.linear_transpose(some, *here)(cotangents)

    rows = None
    if program.rows is not None and not program.rows.summed:
        flags = program.rows.arguments
        known = tuple(flag for k, flag in enumerate(flags) if k not in linear)
        rows = Rows((*known, *(WEIGHTS for _ in given)), tuple(flags[k] is not True for k in linear))
    return Program(pulled, f"pulled_{program.name}", program.options, rows=rows)


def _of_length(aval: Any, rows: int, summed: bool) -> Any:
    """What a share of so many rows has of an argument."""
    return aval if summed else aval.update(shape=(rows, *aval.shape[1:]))


@lru_cache(maxsize=_KEPT)
def _mapped(program: Program, axes: tuple[int | None, ...]) -> Program:
    return Program(jax.vmap(program.part, axes), f"mapped_{program.name}", program.options)


# ------------------------------------------------------------------------------------- primitive

program_p = Primitive("jsmitsm_program")
program_p.multiple_results = True


def _impl(*arguments: Any, program: Program) -> list[Any]:
    rows = program.rows
    shared = None if rows is None else rows.shares(arguments)
    if rows is not None and shared is not None:
        one = lambda share: [np.asarray(x) for x in program.at_hand(share.arguments)]  # noqa: E731
        parts = side_by_side(one, shared, lambda share: (program, share.rows))
        return [jax.device_put(x) for x in rows.together(list(parts), shared)]
    out = program.at_hand(arguments)
    if program.on_host:
        avals = program.result(_avals(arguments)).avals
        return [jax.device_put(np.asarray(x, a.dtype)) for x, a in zip(out, avals, strict=True)]
    return out


def _jvp(primals: Any, tangents: Any, *, program: Program) -> Any:
    out = program_p.bind(*primals, program=program)
    active = tuple(k for k, t in enumerate(tangents) if type(t) is not ad.Zero)
    result = program.result(_avals(primals))
    slopes: list[Any] = [ad.Zero(x.to_tangent_aval()) for x in result.avals]
    reached = result.reached(active)
    if reached:
        moved = program_p.bind(*primals, *(tangents[k] for k in active), program=_moved(program, active, reached))
        slopes = _with(slopes, reached, moved)
    return out, slopes


def _transpose(cotangents: Any, *arguments: Any, program: Program) -> list[Any]:
    linear = tuple(k for k, a in enumerate(arguments) if ad.is_undefined_primal(a))
    given = tuple(k for k, ct in enumerate(cotangents) if type(ct) is not ad.Zero)
    known = [a for k, a in enumerate(arguments) if k not in linear]
    pulled = _pulled(program, linear, tuple(arguments[k].aval for k in linear), given)
    found = program_p.bind(*known, *(cotangents[k] for k in given), program=pulled)
    return _with([None] * len(arguments), linear, found)


def _batch(arguments: Any, axes: Any, *, program: Program) -> Any:
    out = program_p.bind(*arguments, program=_mapped(program, tuple(axes)))
    return out, [0] * len(out)


def _lower(ctx: Any, *arguments: Any, program: Program) -> Any:
    """Inside of a larger program, where a derivative taken outside is called: a part of that."""
    return mlir.lower_fun(lambda *x: jax.tree.leaves(program.part(*x)), True)(ctx, *arguments)


program_p.def_impl(_impl)
program_p.def_abstract_eval(lambda *avals, program: program.result(avals).avals)
ad.primitive_jvps[program_p] = _jvp
ad.primitive_transposes[program_p] = _transpose
batching.primitive_batchers[program_p] = _batch
mlir.register_lowering(program_p, _lower)
