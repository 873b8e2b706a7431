"""Operations performed on small arrays element by element while a residual is recorded, and equal ones once.

Derivatives bring unit vectors along, one for each axis, and most of what is done with them is to multiply by one or by
zero, to add the zeros up, and to carry all of it from array to array. Done here once, it is not done at every
evaluation of the record: what is left are operations on numbers that are really unknown.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from jsmitsm.runtime.jaxprs import bind
from jsmitsm.taylor.elementwise import ELEMENTWISE, RULES, plain_elementwise
from jsmitsm.taylor.series import Ring

# Arrays of up to so many elements are small: gradients, and tensors of second rank in space.
SMALL = 9
# These only place elements, whatever they are.
PLACING = frozenset(
    "reshape squeeze expand_dims broadcast_in_dim tile transpose rev slice split concatenate stack unstack iota".split()
)
# The same whichever operand comes first; and the second operands that give back the first.
COMMUTATIVE = {"mul": jax.lax.mul, "add": jax.lax.add, "add_any": jax.lax.add}
NEUTRAL = {"sub": 0, "div": 1}
# Numbers, and not series: the rules of Taylor arithmetic perform operations on known numbers too.
NUMBERS = Ring(1, 0)


class Elements:
    """Performs operations on values as JAX knows them, and on arrays of objects: the elements of small arrays.

    An element is a number of numpy's where it is known, and a scalar of JAX's where it is not.
    """

    def __init__(self) -> None:
        self._done: dict[Any, Any] = {}
        self._kept: list[Any] = []  # what the keys name by its address

    def __call__(self, eqn: Any, values: Sequence[Any]) -> list[Any]:
        """The results of an operation."""
        name = eqn.primitive.name
        if all(math.prod(np.shape(v)) <= SMALL for v in values) and all(
            math.prod(v.aval.shape) <= SMALL for v in eqn.outvars
        ):
            if name in PLACING:
                return self._placed(eqn, values)
            if name in ELEMENTWISE or name == "convert_element_type":
                return [self._each(eqn, values)]
            if name == "reduce_sum":
                return [self._sum(eqn, values[0])]
            if name == "dot_general" and _only_sums(eqn):
                return [self._dot(eqn, *values)]
        return self._whole(eqn, values)

    def elements(self, value: Any) -> np.ndarray:
        """A small array as the array of its elements."""
        if isinstance(value, np.ndarray) and value.dtype == object:
            return value
        if isinstance(value, np.ndarray | np.generic) or np.shape(value) == ():
            return _objects(value)

        def cut() -> np.ndarray:
            out = np.empty(value.shape, object)
            for place in np.ndindex(out.shape):
                out[place] = jax.lax.reshape(jax.lax.slice(value, place, [k + 1 for k in place]), ())
            return out

        return self._once(("elements", id(value)), [value], cut)

    def whole(self, value: Any) -> Any:
        """An array as JAX knows it."""
        if not (isinstance(value, np.ndarray) and value.dtype == object):
            return value
        parts = list(value.flat)
        if value.shape == ():
            return parts[0]
        if all(map(_known, parts)):
            return np.array(parts, parts[0].dtype).reshape(value.shape)

        def joined() -> Any:
            return jax.lax.reshape(jax.lax.concatenate([jax.lax.reshape(e, (1,)) for e in parts], 0), value.shape)

        return self._once(("whole", value.shape, *map(_name, parts)), parts, joined)

    def _once(self, key: Any, operands: Sequence[Any], make: Any) -> Any:
        """What was made of the operands before, or is made now."""
        if key not in self._done:
            self._done[key] = make()
            self._kept += operands
        return self._done[key]

    def _whole(self, eqn: Any, values: Sequence[Any]) -> list[Any]:
        """As JAX performs it."""
        values = [self.whole(v) for v in values]
        try:
            key = eqn.primitive, tuple(sorted(eqn.params.items())), tuple(map(_name, values)), len(eqn.outvars)
            hash(key)
        except TypeError:  # cannot be compared
            return bind(eqn, *values)
        return self._once(key, values, lambda: bind(eqn, *values))

    def _placed(self, eqn: Any, values: Sequence[Any]) -> list[Any]:
        out = RULES[eqn.primitive.name](NUMBERS, eqn, *(self.elements(v)[None, ..., None] for v in values))
        return [_objects(v[0, ..., 0]) for v in (out if eqn.primitive.multiple_results else [out])]

    def _each(self, eqn: Any, values: Sequence[Any]) -> np.ndarray:
        arrays = np.broadcast_arrays(*map(self.elements, values))
        out = np.empty(arrays[0].shape, object)
        for place in np.ndindex(out.shape):
            out[place] = self._scalar(eqn, [a[place] for a in arrays])
        return out

    def _scalar(self, eqn: Any, values: list[Any]) -> Any:
        name = eqn.primitive.name
        if name in COMMUTATIVE:
            return self._two(COMMUTATIVE[name], *values)
        if name == "convert_element_type" and values[0].dtype == eqn.params["new_dtype"]:
            return values[0]
        if name in NEUTRAL and _is(values[1], NEUTRAL[name]):
            return values[0]
        if all(map(_known, values)):
            rows = [np.asarray(v).reshape(1, 1) for v in values]
            return (RULES[name](NUMBERS, eqn, *rows) if name in RULES else plain_elementwise(eqn, rows))[0, 0]
        return self._whole(eqn, values)[0]

    def _two(self, operation: Any, x: Any, y: Any) -> Any:
        """The sum or the product of two numbers."""
        product = operation is jax.lax.mul
        for one, other in ((x, y), (y, x)):
            if _is(one, 1 if product else 0):
                return other
            if product and _is(one, 0):
                return one
        if _known(x) and _known(y):
            return x * y if product else x + y
        return self._once((operation, frozenset((_name(x), _name(y)))), (x, y), lambda: operation(x, y))

    def _sum(self, eqn: Any, value: Any) -> np.ndarray:
        axes = tuple(eqn.params["axes"])
        rows = np.moveaxis(self.elements(value), axes, range(len(axes)))
        return self._added(rows.reshape(-1, *rows.shape[len(axes) :]), eqn)

    def _dot(self, eqn: Any, x: Any, y: Any) -> np.ndarray:
        (left, right), _ = eqn.params["dimension_numbers"]
        x = np.moveaxis(self.elements(x), left, range(len(left)))
        y = np.moveaxis(self.elements(y), right, range(len(right)))
        x, y = x.reshape(-1, *x.shape[len(left) :]), y.reshape(-1, *y.shape[len(right) :])
        out = np.empty((len(x), *x.shape[1:], *y.shape[1:]), object)
        for place in np.ndindex(out.shape):
            row, column = (place[0], *place[1 : x.ndim]), (place[0], *place[x.ndim :])
            out[place] = self._two(jax.lax.mul, x[row], y[column])
        return self._added(out, eqn)

    def _added(self, rows: np.ndarray, eqn: Any) -> np.ndarray:
        """The sum along the first axis."""
        out = _objects(np.zeros(rows.shape[1:], eqn.outvars[0].aval.dtype))
        for row in rows:
            for place in np.ndindex(out.shape):
                out[place] = self._two(jax.lax.add, out[place], row[place])
        return out


def _known(value: Any) -> bool:
    return isinstance(value, np.ndarray | np.generic)


def _is(value: Any, number: int) -> bool:
    return _known(value) and bool(value == number)


def _only_sums(eqn: Any) -> bool:
    """Whether a product of arrays sums over axes, and does nothing else."""
    _, (batch, _) = eqn.params["dimension_numbers"]
    return not batch and len({v.aval.dtype for v in (*eqn.invars, *eqn.outvars)}) == 1


def _objects(value: Any) -> np.ndarray:
    """The elements of an array of numpy's, each with its dtype, or a scalar as an array."""
    if isinstance(value, np.ndarray) and value.dtype == object:
        return value
    out = np.empty(np.shape(value), object)
    for place in np.ndindex(out.shape):
        out[place] = value[place] if isinstance(value, np.ndarray) else value
    return out


def _name(value: Any) -> Any:
    """What tells a value from others while it is kept: numbers are the same by what they are."""
    return (value.dtype.str, value.shape, value.tobytes()) if _known(value) else id(value)
