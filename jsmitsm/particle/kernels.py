"""Kernels (weight functions) as pytrees; every derivative a method needs comes from AD."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np

from jsmitsm.runtime.arrays import Array, ArrayLike
from jsmitsm.runtime.errors import did_you_mean, explaining, in_words, short
from jsmitsm.runtime.snapshot import ScalarFunction, snapshot
from jsmitsm.runtime.tracers import is_traced

# A particle that sits on the edge of a support belongs to it; rounding must not decide that.
EDGE = 1.0 + 1e-9


@jax.tree_util.register_pytree_node_class
class Kernel:
    """A radial weight function of the scaled distance r = |x - x_i| / h, zero beyond r = d.

    A kernel is a pytree whose leaves are ``h``, ``d`` and ``params``, so gradients flow to them.

    Parameters
    ----------
    profile : function
        Function r -> weight of a scalar scaled distance, written in ``jax.numpy``; with ``params`` it is called as
        ``profile(r, params)``.
    h : float or array_like (N,)
        Smoothing length in length units, a positive scalar or an (N,) array, one per particle.
    d : float
        Dimensionless support radius; a particle has the neighbours |x - x_i| <= d h.
    params : pytree, optional
        Any pytree of numbers, further parameters of the profile.

    Raises
    ------
    ValueError
        For an h or d that is not positive and finite, and a profile that is no function of a scalar.

    Examples
    --------
    >>> import jsmitsm as js
    >>> kernel = js.Kernel(lambda r: (2.0 - r) ** 4, h=0.1, d=2.0)
    >>> float(kernel.weight(1.0)), float(kernel.weight(2.5))
    (1.0, 0.0)
    >>> kernel.replace(h=0.2)
    Kernel(h=0.2, d=2)
    """

    @explaining
    def __init__(self, profile: Callable[..., Any], h: ArrayLike, d: ArrayLike, params: Any = None):
        if not callable(profile):
            raise ValueError(f"profile: expected a function of the scaled distance r, got {type(profile).__name__}; "
                             "the package's own kernels are e.g. js.SuperGaussian(h, d)")  # fmt: skip
        self._profile = profile
        self.params = params
        self._set(h, d)
        _check_profile(self)

    def _set(self, h: ArrayLike, d: ArrayLike) -> None:
        self.h: float | Array = _checked(h, "h", (0, 1))
        self.d: float | jax.Array = _checked(d, "d", (0,))

    def profile(self, r: Any) -> jax.Array:
        """The weight before the support cuts it off.

        Parameters
        ----------
        r : array_like
            Scaled distances |x - x_i| / h, of any shape.

        Returns
        -------
        jax.Array
            Of the shape of ``r``.

        Examples
        --------
        >>> import jsmitsm as js
        >>> float(js.Wendland(h=0.1, d=2.0).profile(0.0))
        1.0
        """
        return self._profile(r) if self.params is None else self._profile(r, self.params)

    def weight(self, r: Any) -> jax.Array:
        """The weight, zero outside the support.

        Parameters
        ----------
        r : array_like
            Scaled distances |x - x_i| / h, of any shape.

        Returns
        -------
        jax.Array
            Of the shape of ``r``.

        Examples
        --------
        >>> import jsmitsm as js
        >>> float(js.Constant(h=0.1, d=2.0).weight(2.5))
        0.0
        """
        return jnp.where(r <= self.d * EDGE, self.profile(r), 0.0)

    def recorded(self) -> Kernel:
        """The same kernel with the user's profile as it is now: compiled programs are kept under what it computes."""
        if self._profile is None or isinstance(self._profile, ScalarFunction):
            return self
        profile = ScalarFunction(self._profile, *(() if self.params is None else (self.params,)))
        return self if profile.traced else self._with(profile)

    def as_written(self) -> Kernel:
        """The same kernel with the profile that the user wrote."""
        return self._with(self._profile.function) if isinstance(self._profile, ScalarFunction) else self

    def _with(self, profile: Callable[..., Any]) -> Kernel:
        return type(self).tree_unflatten(profile, (self.h, self.d, self.params))

    @property
    def length(self) -> float | Array:
        """The length by which offsets are divided, of the size of the support: a scalar or (N,), like ``h``."""
        xp = jnp if is_traced(self.h, self.d) else np
        return self.h * xp.minimum(self.d, 2.0)

    def at(self, i: Any) -> Kernel:
        """The kernel of one particle: its own smoothing length where there is one per particle.

        Parameters
        ----------
        i : int
            Number of the particle.

        Returns
        -------
        Kernel
            With a scalar ``h``.

        Examples
        --------
        >>> import jsmitsm as js
        >>> js.Gaussian(h=[0.1, 0.2], d=2.0).at(1)
        Gaussian(h=0.2, d=2)
        """
        return self.replace(h=cast(Array, self.h)[i]) if jnp.ndim(self.h) else self

    @explaining
    def replace(self, **changes: Any) -> Kernel:
        """The same kernel with other numbers.

        Parameters
        ----------
        **changes : any
            ``h``, ``d`` or ``params``.

        Returns
        -------
        Kernel
            A new one; this one stays.

        Raises
        ------
        ValueError
            For other names, and numbers that are not positive and finite.

        Examples
        --------
        >>> import jsmitsm as js
        >>> js.Gaussian(h=0.1, d=2.0).replace(h=0.3)
        Gaussian(h=0.3, d=2)
        """
        unknown = sorted(set(changes) - {"h", "d", "params"})
        if unknown:
            raise ValueError(f"{unknown[0]}: no parameter of {type(self).__name__}; it has 'h', 'd' and 'params'"
                             + did_you_mean(unknown[0], ("h", "d", "params")))  # fmt: skip
        _, aux = self.tree_flatten()
        for name, dims in (("h", (0, 1)), ("d", (0,))):
            if name in changes:
                changes[name] = _checked(changes[name], name, dims)
        leaves = tuple(changes.get(name, getattr(self, name)) for name in ("h", "d", "params"))
        return type(self).tree_unflatten(aux, leaves)

    def tree_flatten(self):
        return (self.h, self.d, self.params), self._profile

    @classmethod
    def tree_unflatten(cls, aux, leaves):
        new = object.__new__(cls)
        new.h, new.d, new.params = leaves
        new._profile = aux
        return new

    def __repr__(self) -> str:
        return f"{type(self).__name__}(h={_short(self.h)}, d={_short(self.d)})"


class _Named(Kernel):
    """A kernel with a profile of its own: needs only h and d."""

    @explaining
    def __init__(self, h: ArrayLike, d: ArrayLike):
        self._profile = None  # type: ignore[assignment]  # the class has its own
        self.params = None
        self._set(h, d)


@jax.tree_util.register_pytree_node_class
class SuperGaussian(_Named):
    r"""The revised super Gauss function, W(r) = (d^2 - r^2) exp(-r^2) for r <= d.

    Karamanli (2015), eq. (30) and (35). Its factor G / (h sqrt(pi))^D with G = 1.04823, 1.10081,
    1.18516 for D = 1, 2, 3 is ``normalization``; it cancels from every moment system.

    Parameters
    ----------
    h : float or array (N,)
        Smoothing length, length units.
    d : float
        Support radius in smoothing lengths.

    Examples
    --------
    >>> import jsmitsm as js
    >>> round(float(js.SuperGaussian(h=0.1, d=2.0).profile(0.0)), 3)
    4.0
    """

    def profile(self, r: Any) -> jax.Array:
        return (self.d**2 - r**2) * jnp.exp(-(r**2))

    @explaining
    def normalization(self, dim: int) -> float | Array:
        """The constant G / (h sqrt(pi))^D of eq. (30).

        Parameters
        ----------
        dim : int
            D, the number of space dimensions.

        Returns
        -------
        float or array (N,)
            Of the shape of ``h``.

        Raises
        ------
        ValueError
            Unless ``dim`` is 1, 2 or 3.

        Examples
        --------
        >>> import jsmitsm as js
        >>> round(float(js.SuperGaussian(h=1.0, d=2.0).normalization(2)), 4)
        0.3504
        """
        if dim not in (1, 2, 3):
            raise ValueError(f"dim: expected 1, 2 or 3 dimensions, got {dim!r}")
        return (1.04823, 1.10081, 1.18516)[dim - 1] / (self.h * np.sqrt(np.pi)) ** dim


@jax.tree_util.register_pytree_node_class
class Gaussian(_Named):
    """W(r) = exp(-r^2) for r <= d.

    Parameters
    ----------
    h : float or array (N,)
        Smoothing length, length units.
    d : float
        Support radius in smoothing lengths.

    Examples
    --------
    >>> import jsmitsm as js
    >>> float(js.Gaussian(h=0.1, d=2.0).weight(0.0))
    1.0
    """

    def profile(self, r: Any) -> jax.Array:
        return jnp.exp(-(r**2))


def fitted(farthest: Any, decay: float = 2.0) -> Gaussian:
    """What stands for a kernel where none is given: it has fallen to exp(-decay^2) at the farthest neighbour."""
    return Gaussian.tree_unflatten(None, (farthest / decay, decay, None))


@jax.tree_util.register_pytree_node_class
class Wendland(_Named):
    """Wendland's C4 function, W = (1 - q)^6 (35 q^2 + 18 q + 3) / 3 with q = r / d.

    H. Wendland, Adv. Comput. Math. 4 (1995) 389-396.

    Parameters
    ----------
    h : float or array (N,)
        Smoothing length, length units.
    d : float
        Support radius in smoothing lengths.

    Examples
    --------
    >>> import jsmitsm as js
    >>> float(js.Wendland(h=0.1, d=2.0).weight(2.0))
    0.0
    """

    def profile(self, r: Any) -> jax.Array:
        q = r / self.d
        return (1 - q) ** 6 * (35 * q**2 + 18 * q + 3) / 3


@jax.tree_util.register_pytree_node_class
class CubicSpline(_Named):
    """The cubic B-spline M4 of particle hydrodynamics, stretched to the support r <= d.

    W = 1 - 6 q^2 + 6 q^3 for q = r / d <= 1/2, and 2 (1 - q)^3 up to q = 1.
    J. J. Monaghan and J. C. Lattanzio, Astron. Astrophys. 149 (1985) 135-143.

    Parameters
    ----------
    h : float or array (N,)
        Smoothing length, length units.
    d : float
        Support radius in smoothing lengths.

    Examples
    --------
    >>> import jsmitsm as js
    >>> float(js.CubicSpline(h=0.1, d=2.0).weight(1.0))
    0.25
    """

    def profile(self, r: Any) -> jax.Array:
        q = r / self.d
        return jnp.where(q <= 0.5, 1 - 6 * q**2 + 6 * q**3, 2 * (1 - q) ** 3)


@jax.tree_util.register_pytree_node_class
class Constant(_Named):
    """W = 1 inside the support. Its derivatives vanish: methods II and III need another kernel.

    Parameters
    ----------
    h : float or array (N,)
        Smoothing length, length units.
    d : float
        Support radius in smoothing lengths.

    Examples
    --------
    >>> import jsmitsm as js
    >>> float(js.Constant(h=0.1, d=2.0).weight(1.9))
    1.0
    """

    def profile(self, r: Any) -> jax.Array:
        return jnp.ones_like(r)


def _checked(value: Any, name: str, dims: tuple[int, ...]) -> Any:
    """A positive finite kernel parameter; traced values pass through."""
    if isinstance(value, jax.core.Tracer):
        return value
    try:
        array = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise TypeError
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name}: expected a positive number, got {short(value)}") from None
    if array.ndim not in dims or not array.size:
        kinds = "a scalar or an (N,) array" if 1 in dims else "a scalar"
        raise ValueError(f"{name}: expected {kinds}, got an array of shape {array.shape}")
    if not (np.isfinite(array) & (array > 0)).all():
        raise ValueError(f"{name}: expected positive finite values, got {_short(array)}; {name} scales the support")
    if isinstance(value, jax.Array):
        return value
    return float(array) if array.ndim == 0 else array


def _check_profile(kernel: Kernel) -> None:
    """Call a user's profile once without numbers: its signature and shape come to light."""
    said = "profile: expected a jax.numpy function of the scaled distance r (and of params, where given)"
    try:
        shape = np.shape(snapshot(kernel.profile, jax.ShapeDtypeStruct((), jnp.result_type(float)))[1])
    except Exception as error:
        raise ValueError(f"{said}, but calling it failed: {in_words(error)}") from error
    if shape != ():
        raise ValueError(f"{said} that returns a scalar for a scalar, got shape {shape}")


def _short(value: Any) -> str:
    if isinstance(value, jax.core.Tracer):
        return str(value.aval.str_short())
    array = np.asarray(value)
    return f"{array.min():.4g}..{array.max():.4g} ({array.size} particles)" if array.ndim else f"{float(array):.6g}"
