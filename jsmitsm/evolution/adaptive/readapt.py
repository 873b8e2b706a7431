"""What is asked of an evolution that makes its own clouds."""

from __future__ import annotations

from dataclasses import dataclass

from jsmitsm.adaptation.first_cloud import Make, refuse_no_maker
from jsmitsm.runtime.errors import explaining, is_number, is_whole, short


@dataclass(frozen=True)
class Readapt:
    """How ``js.evolve`` makes its cloud anew on the way: ``readapt=js.Readapt(make, tol)``.

    Attributes
    ----------
    make : function
        Spacing -> ``js.Cloud``, as ``js.adapt`` takes it; the groups have the names of those of the first cloud.
    tol : float
        Wanted error of the whole run, relative to the largest value; every part of the time may make its share of it.
    times : int
        The time is cut into so many equal parts. A part whose error is too large is repeated on another cloud.
    max_particles : int
        No cloud has more.

    Raises
    ------
    ValueError
        For anything else.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.Readapt(lambda spacing: js.interval(0.0, 1.0, spacing=spacing), 1e-4).times
    20
    """

    make: Make
    tol: float
    times: int = 20
    max_particles: int = 300_000

    @explaining
    def __post_init__(self) -> None:
        refuse_no_maker(self.make)
        if not is_number(self.tol) or not 0.0 < self.tol < 1.0:
            raise ValueError(f"tol: expected a relative error between 0 and 1, got {short(self.tol)}")
        for value, name in ((self.times, "times"), (self.max_particles, "max_particles")):
            if not is_whole(value, 1):
                raise ValueError(f"{name}: expected a whole number from 1, got {short(value)}")
