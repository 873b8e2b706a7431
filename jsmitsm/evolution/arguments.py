"""Arguments of an evolution, judged before any work."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.cloud.regions.region_cloud import RegionCloud
from jsmitsm.discretization.regions.rows import spread_values
from jsmitsm.equation.problem import Problem
from jsmitsm.equation.unknowns.extras import refuse_extras
from jsmitsm.runtime.errors import is_number, is_whole, numbers, refuse_masked, refuse_no_switch, refuse_word, short
from jsmitsm.runtime.tracers import is_traced
from jsmitsm.taylor.multi_indices import HIGHEST

Scheme: TypeAlias = Literal["auto", "esdirk", "radau", "imex", "euler"]
"""What ``scheme`` may be, a type for annotations."""
SCHEMES = get_args(Scheme)
MOST_STEPS = 10_000_000


def check(problem, cloud, t, steps, tol, order, scheme, throw, progress) -> None:
    """ValueError for what cannot be right, with the remedy."""
    refuse_extras(problem)
    for value, kind, name in ((problem, Problem, "problem"), (cloud, Cloud, "cloud")):
        if not isinstance(value, kind):
            raise ValueError(f"{name}: expected a js.{kind.__name__}, got {type(value).__name__}")
    if not isinstance(t, (tuple, list)) or len(t) != 2:
        raise ValueError(f"t: expected the start and the end, t=(t0, t1), got {short(t)}")
    if not is_traced(t):
        try:
            t0, t1 = (float(v) for v in t)
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"t: expected two numbers, t=(t0, t1), got {short(t)}") from None
        if not (np.isfinite(t0) and np.isfinite(t1)) or t1 <= t0:
            raise ValueError(f"t: expected finite times with t0 < t1, got ({t0:g}, {t1:g})")
    if (steps is None) == (tol is None):
        raise ValueError(
            "steps, tol: give exactly one of them: steps=100 for so many equal steps, or tol=1e-6 for steps that keep "
            f"the error in time below so much of the solution; got steps={short(steps)}, tol={short(tol)}"
        )
    if steps is not None:
        if not is_whole(steps, 1, MOST_STEPS):
            raise ValueError(f"steps: expected a whole number from 1 to {MOST_STEPS:,}, got {short(steps)}")
    if tol is not None:
        if not is_number(tol) or not 1e-13 <= tol <= 0.1:
            raise ValueError(f"tol: expected a number from 1e-13 to 0.1, relative to the solution, got {short(tol)}")
    refuse_word("scheme", scheme, SCHEMES)
    if not is_whole(order, 1, HIGHEST):
        raise ValueError(f"order: expected a whole number from 1 to {HIGHEST}, got {short(order)}")
    refuse_no_switch("throw", throw)
    refuse_no_switch("progress", progress)


def saved_times(save: Any, t0: float, t1: float) -> np.ndarray:
    """The times to save as parts of the whole, from 0 to 1."""
    if save is None:
        return np.array([0.0, 1.0])
    if is_whole(save):
        if not 1 <= save <= MOST_STEPS:
            raise ValueError(f"save: expected 1 to {MOST_STEPS:,} intervals, or an array of times, got {short(save)}")
        return np.linspace(0.0, 1.0, int(save) + 1)
    try:
        times = numbers("save", save)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"save: expected a number of intervals or an array of times, got {short(save)}") from None
    if times.ndim != 1 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError(f"save: expected a number of intervals or ascending finite times, got {short(save)}")
    slack = 1e-12 * (t1 - t0)
    if len(times) and (times[0] < t0 - slack or times[-1] > t1 + slack):
        raise ValueError(
            f"save: times from {times[0]:g} to {times[-1]:g}, but the evolution goes from {t0:g} to {t1:g}"
        )
    parts = np.clip((times - t0) / (t1 - t0), 0.0, 1.0)
    parts = parts[(parts > 1e-12) & (parts < 1.0 - 1e-12)]
    return np.concatenate([[0.0], parts, [1.0]])


def starting_values(u0: Any, cloud: Cloud, fields: int, second: bool) -> tuple[Any, ...]:
    """Values (N, F) at the start, and rates where the problem is of second order in time."""
    if not second:
        return (_values(u0, cloud, fields, "u0"),)
    if not isinstance(u0, (tuple, list)) or len(u0) != 2:
        raise ValueError(
            "u0: the problem is of second order in time and starts from a pair (u, its rate), each a function of x, a "
            f"number or an array; got {short(u0)}"
        )
    return tuple(_values(v, cloud, fields, f"u0[{k}]") for k, v in enumerate(u0))


def _values(given: Any, cloud: Cloud, fields: int, name: str) -> Any:
    n = len(cloud)
    if isinstance(given, Mapping):
        return _of_regions(given, cloud, fields, name)
    if callable(given):
        try:
            values: Any = sampled(given, cloud.points, fields, name)
        except TypeError as error:
            raise ValueError(f"{name}: expected a function of x alone; calling it failed: {error}") from error
        values = values if is_traced(values) else np.array(values)
    else:
        refuse_masked(given, name)
        try:
            values = given if is_traced(given) else np.array(numbers(name, given))
        except (TypeError, ValueError, OverflowError):
            raise ValueError(f"{name}: expected a function of x, a number or an array, got {short(given)}") from None
        if np.ndim(values) == 0 or (fields > 1 and np.shape(values) == (fields,)):
            values = (jnp if is_traced(values) else np).broadcast_to(values, (n, fields))
        if np.shape(values) == (n,) and fields == 1:
            values = values[:, None]
        if np.shape(values) != (n, fields):
            raise ValueError(
                f"{name}: expected a function of x or an array ({n},{f' {fields}' if fields > 1 else ''}), got shape "
                f"{np.shape(given)}"
            )
    if not is_traced(values) and not np.isfinite(values).all():
        bad = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
        raise ValueError(f"{name}: NaN or infinite at particle {bad}; start from finite values")
    return values


def _of_regions(given: Mapping[str, Any], cloud: Cloud, fields: int, name: str) -> Any:
    """Values (N, F) by region."""
    if not isinstance(cloud, RegionCloud) or set(given) != set(cloud.regions):
        known = list(cloud.regions) if isinstance(cloud, RegionCloud) else "none"
        raise ValueError(f"{name}: values for the regions {list(given)}; the cloud has {known}")
    found = [_values(given[r], cloud.region(r), fields, f"{name}[{r!r}]") for r in cloud.regions]
    return spread_values(found, list(cloud.regions.values()), (len(cloud), fields))


def sampled(given: Any, points: Any, fields: int, name: str = "u0") -> Any:
    """A function of x at points (M, D): (M, F)."""
    return jax.vmap(lambda x: _vector(given(x), fields, name))(jnp.asarray(points))


def _vector(value: Any, fields: int, name: str) -> Any:
    value = jnp.stack([jnp.asarray(v, float) for v in value]) if isinstance(value, (tuple, list)) else value
    value = jnp.asarray(value, float)
    if value.ndim == 0:
        return jnp.full((fields,), value)
    if value.shape != (fields,):
        raise ValueError(f"{name}: expected a function of x returning {fields} value(s), got shape {value.shape}")
    return value
