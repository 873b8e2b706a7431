"""What an evolution returns whose cloud was made anew on the way."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from jsmitsm.cloud.cloud import Cloud
from jsmitsm.evolution.evolution import Evolution
from jsmitsm.runtime import notebooks
from jsmitsm.runtime.errors import explaining, is_number, short
from jsmitsm.solution.solution import Solution


@dataclass
class AdaptedEvolution:
    """A solution in time on clouds that follow it, from ``js.evolve(..., readapt=...)``.

    Attributes
    ----------
    t : array (S,)
        The saved times, from the start to the end; ``at`` knows those between them too.
    parts : list of Evolution
        One after the other, each on a cloud of its own or on that of the one before.
    error : float
        Estimated error at the end, relative to the largest value: what the parts make and passing from cloud to cloud
        changed, as the equation takes it along to the end.
    reached : bool
        Whether that is within the tolerance, the end was reached, and no part has a flag.
    tol : float
        What was asked for.
    history : dict
        Of every part, ready to plot: ``"t"`` (its end), ``"particles"``, ``"error"`` (of the run so far),
        ``"smallest"`` (the smallest spacing), ``"attempts"``, ``"seconds"``.
    messages : list of str
        What limited it.

    Examples
    --------
    >>> import jax; jax.config.update("jax_enable_x64", True)
    >>> import jax.numpy as jnp, jsmitsm as js
    >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
    >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
    >>> line = lambda spacing: js.interval(0.0, 1.0, spacing=spacing)
    >>> run = js.evolve(
    ...     heat,
    ...     line(0.05),
    ...     lambda x: jnp.sin(jnp.pi * x[0]),
    ...     t=(0.0, 0.1),
    ...     steps=20,
    ...     readapt=js.Readapt(line, 1e-4, times=4),
    ... )
    >>> run.reached, len(run.parts)
    (True, 4)
    >>> bool(abs(run.at(0.05)([[0.5]])[0] - jnp.exp(-jnp.pi**2 * 0.05)) < 1e-4)
    True
    """

    t: np.ndarray
    parts: list[Evolution]
    error: float
    tol: float
    history: dict[str, np.ndarray]
    messages: list[str] = field(default_factory=list)

    @property
    def cloud(self) -> Cloud:
        """That of the end."""
        return self.parts[-1].cloud

    @property
    def converged(self) -> bool:
        """Whether the run reached its end."""
        return all(bool(part.converged) for part in self.parts)

    @property
    def flags(self) -> list[str]:
        """What speaks against any of the parts, a sentence each."""
        return list(dict.fromkeys(line for part in self.parts for line in part.flags))

    @property
    def reached(self) -> bool:
        """Whether the tolerance was reached and nothing speaks against it."""
        return self.converged and self.error <= self.tol and not self.flags

    @explaining
    def at(self, t: Any) -> Solution:
        """The solution at any time, on the cloud of that time.

        Parameters
        ----------
        t : float
            The time.

        Returns
        -------
        Solution
            Of that moment; its particles are ``.cloud``.

        Raises
        ------
        ValueError
            For times outside of the run.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
        >>> line = lambda spacing: js.interval(0.0, 1.0, spacing=spacing)
        >>> run = js.evolve(
        ...     heat,
        ...     line(0.05),
        ...     lambda x: jnp.sin(jnp.pi * x[0]),
        ...     t=(0.0, 0.1),
        ...     steps=20,
        ...     readapt=js.Readapt(line, 1e-4, times=2),
        ... )
        >>> round(float(run.at(0.05)([[0.5]])[0]), 3)
        0.611
        """
        if not is_number(t):
            raise ValueError(f"t: expected a number, got {short(t)}")
        ends = [float(part.t[-1]) for part in self.parts]
        which = min(int(np.searchsorted(ends, float(t))), len(ends) - 1)
        return self.parts[which].at(t)

    def diagnose(self) -> str:
        """In words: how it went, and what limited it.

        Returns
        -------
        str
            Several lines; those that begin with FLAG speak against the run.

        Examples
        --------
        >>> import jax; jax.config.update("jax_enable_x64", True)
        >>> import jax.numpy as jnp, jsmitsm as js
        >>> ends = {"left": js.dirichlet(0.0), "right": js.dirichlet(0.0)}
        >>> heat = js.Problem(lambda u, x, t: js.dt(u)(x) - js.laplacian(u)(x), ends)
        >>> line = lambda spacing: js.interval(0.0, 1.0, spacing=spacing)
        >>> run = js.evolve(
        ...     heat,
        ...     line(0.05),
        ...     lambda x: jnp.sin(jnp.pi * x[0]),
        ...     t=(0.0, 0.1),
        ...     steps=20,
        ...     readapt=js.Readapt(line, 1e-4, times=2),
        ... )
        >>> "FLAG" in run.diagnose()
        False
        """
        flags = [f"FLAG: {line}" for line in self.flags]
        clouds = len({id(part.cloud) for part in self.parts})
        steps = sum(part.stats["steps"] for part in self.parts)
        told = f"{steps} steps of {self.parts[-1].stats['scheme']} on {clouds} cloud{'s' if clouds > 1 else ''}."
        return "\n".join([repr(self), *self.messages, *flags, told])

    def __repr__(self) -> str:
        count = self.history["particles"]
        return (
            f"AdaptedEvolution(t: {float(self.t[0]):g} to {float(self.t[-1]):g}, error={self.error:.2g}, "
            f"tol={self.tol:.2g}, reached={self.reached}, {int(count.min())} to {int(count.max())} particles)"
        )

    def _repr_html_(self) -> str:
        rows: list[tuple[str, Any]] = [("t", f"{notebooks.span(self.t)}, {len(self.t)} saved")]
        rows += [("estimated error", f"{self.error:.2g}, {self.tol:.2g} asked for"), ("reached", self.reached)]
        rows += [("particles", notebooks.span(self.history["particles"])), ("flags", " ".join(self.flags) or "none")]
        return notebooks.shown("AdaptedEvolution", [*rows, ("besides", " ".join(self.messages) or "nothing")])
