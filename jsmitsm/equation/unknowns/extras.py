"""What only some problems have: constraints, global unknowns, complex values, point sources, integral terms.

All others have none of it, and take the usual path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

from jsmitsm.equation.unknowns.constraint import Constraint, checked_number
from jsmitsm.equation.unknowns.integral import Kernels, kernels
from jsmitsm.equation.unknowns.point_source import PointSource
from jsmitsm.runtime.errors import listed, short


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["constraints", "unknowns", "sources"],
    meta_fields=["complex_values", "kernels"],
)
@dataclass
class Extras:
    """Constraints, global unknowns with the numbers to start from, whether u is complex, point sources, integrals."""

    constraints: tuple[Constraint, ...]
    unknowns: dict[str, Any]
    complex_values: bool
    sources: tuple[PointSource, ...]
    kernels: Kernels = ()


def extras(
    constraints: Sequence[Constraint], unknowns: Mapping[str, Any] | None, dtype: Any,
    sources: Sequence[PointSource], integral: Any, pde: Any, bcs: Mapping[str, Any],
) -> Extras | None:  # fmt: skip
    """What the user gave, judged; None for a problem without any of it."""
    given: list[Any] = list(constraints) if isinstance(constraints, (list, tuple)) else [constraints]
    for k, one in enumerate(given):
        if not isinstance(one, Constraint):
            raise ValueError(f"constraints[{k}]: expected js.constraint(functional, value), got {short(one)}")
    if unknowns is not None and not isinstance(unknowns, Mapping):
        raise ValueError(
            f"unknowns: expected a dict from name to the number to start from, got {short(unknowns)}; write e.g. "
            '{"potential": 0.0}'
        )
    started = dict(unknowns or {})
    for name, start in started.items():
        if not isinstance(name, str):
            raise ValueError(f"unknowns: the key {name!r} is no string; name every unknown")
        checked_number(start, f"unknowns[{name!r}]")
    if started and not given:
        raise ValueError(
            f"constraints: {len(started)} unknown(s), {', '.join(map(repr, started))}, and no constraint; give one "
            "js.constraint(functional, value) for each"
        )
    complex_values = _is_complex(dtype)
    points = [sources] if isinstance(sources, PointSource) else listed("sources", sources, "js.point_source(...)s")
    for k, source in enumerate(points):
        if not isinstance(source, PointSource):
            raise ValueError(f"sources[{k}]: expected js.point_source(x0, strength), got {short(source)}")
    found = kernels(integral, pde)
    if found and (points or complex_values):
        raise ValueError(
            "integral: integral terms are made for real problems without point sources; write a complex problem as two "
            "fields"
        )
    if points and (given or complex_values):
        raise ValueError("sources: point sources are made for real problems without constraints and global unknowns")
    if complex_values and given:
        raise ValueError(
            "dtype: constraints and global unknowns are made for real problems; write the two parts as two fields"
        )
    if not complex_values:
        _refuse_complex(bcs)
    if not (given or complex_values or points or found):
        return None
    return Extras(tuple(given), started, complex_values, tuple(points), found)


def _is_complex(dtype: Any) -> bool:
    try:
        kind = np.dtype(dtype).kind if isinstance(dtype, (type, np.dtype, str)) else ""  # a number has a dtype too
    except TypeError:
        kind = ""
    if kind not in "fc" or not kind:
        raise ValueError(f"dtype: expected float or complex, got {short(dtype)}")
    return kind == "c"


def _refuse_complex(bcs: Mapping[str, Any]) -> None:
    for name, conditions in bcs.items():
        for c in conditions:
            for part, value in c.parts.items():
                if not callable(value) and np.iscomplexobj(value):
                    raise ValueError(
                        f"bcs[{name!r}]: {part} of js.{c.kind} is complex, the problem real; write "
                        "js.Problem(..., dtype=complex)"
                    )


def refuse_extras(problem: Any) -> None:
    """ValueError where another verb than js.solve is asked for a problem with such parts."""
    found = getattr(problem, "extras", None)
    if found is not None and found.complex_values:
        raise ValueError(
            "problem: dtype=complex is for js.solve alone; this is not made for it: write the real and the imaginary "
            "part as two fields"
        )
    if found is not None and found.sources:
        raise ValueError("problem: point sources are for js.solve alone; this is not made for them")
    if found is not None and found.kernels:
        raise ValueError("problem: integral terms are for js.solve alone; this is not made for them")
    if found is not None:
        raise ValueError(
            "problem: constraints and global unknowns are found by js.solve alone; this is not made for them"
        )
