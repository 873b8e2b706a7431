"""One implicit step after another on the host, with a factor kept for every step size.

All stages are written in values, not in rates: with P_j = F(t_j) - A Y_j and Q_j = -B N(Y_j) stage i solves

    (E + g h A) Y_i = E y + H(t) - H(t_i) + h sum_{j<i} (a_ij P_j + e_ij Q_j) + g h F(t_i)

and where N is explicit the end of a step is that of its weights b, no stage: E Y = E Y_s + h sum_j (b_j - e_sj) Q_j.
H is what the held particles' values contribute to E: their rates are never needed, and what jumps at the start
enters as the impulse that it is. Equations without a rate are welcome where all is implicit: there is no solve with E.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from jsmitsm.evolution.space.system import System
from jsmitsm.evolution.steps.tableaux import RADAU, Additive


class Drive(Protocol):
    """What drives a system: forces F, the held values' part of E, H, and the held values themselves."""

    def start(self, t: float) -> tuple[Any, Any, Any]:
        """At a moment: (size,), (size,), (held,)."""

    def step(self, t: float, h: float) -> tuple[Any, Any, Any]:
        """At the implicit stages of a step: (s, size), (s, size), (s, held)."""


# The error of one that is over soon, 1 / h and more, is up to so many times what the embedded weights make of it.
SOON = 10.0
# The mean of t^2 (t - c_1)(t - c_2)(t - c_3) over a step of Radau IIA, of which those of 1 and t are zero; and by how
# much more is told than the filter leaves of it.
_MEAN, _MORE = -1.0 / 600.0, 2.0

# What is added explicitly, -B N: (state, time, held values) -> (size,).
Explicit = Callable[[Any, float, Any], Any]


class Stopped(Exception):
    """A step that cannot be made, in words."""


@dataclass
class Step:
    """What a step leaves to the next and to the adjoint."""

    y: np.ndarray
    force: np.ndarray  # F and H at the end
    held: np.ndarray
    known: np.ndarray  # the held values
    slope: np.ndarray  # P at the end
    pushed: Any  # Q at the end
    # the implicit ones, and the end where it is none of them
    stages: list[np.ndarray] = field(default_factory=list)
    error: np.ndarray | None = None


class Stepper:
    """Steps of an additive scheme; ``first`` makes what the first one needs, ``advance`` the next."""

    def __init__(self, system: System, drive: Drive, scheme: Additive, explicit: Explicit | None = None,
                 newton: Any = None):  # fmt: skip
        self.system, self.drive, self.scheme = system, drive, scheme
        self.explicit, self.newton = explicit, newton
        self.still, self.closes = system.undriven(), explicit is not None and newton is None

    @property
    def order(self) -> int:
        return self.scheme.order

    def smallest(self, h: float) -> float:
        """The step of backward Euler that its factor serves."""
        return h * self.scheme.gamma

    def first(self, y: np.ndarray, t: float) -> Step:
        """The start: forces and slopes there."""
        return self._ended(y, t, *self.drive.start(t))

    def _ended(self, y: np.ndarray, t: float, force: Any, held: Any, known: Any) -> Step:
        slope = force - self.system.stiff(y)
        pushed = None if self.explicit is None else self.explicit(y, t, known)
        if pushed is not None and self.newton is not None:
            slope, pushed = slope + pushed, None
        slope[self.still] = 0.0  # these hold at every stage anew, whatever the start was
        return Step(y, force, held, known, slope, pushed)

    def advance(self, last: Step, t: float, h: float, estimate: bool = False) -> Step:
        s, system = self.scheme, self.system
        resolvent = system.resolvent(h * s.gamma)
        force, held, known = self.drive.step(t, h)
        base = system.mass(last.y) + last.held
        slopes, pushes, stages = [last.slope], [last.pushed], []
        now, y = last, last.y
        for i in range(1, s.stages):
            r = base - held[i - 1] + (h * s.gamma) * force[i - 1]
            for j in range(i):
                r += (h * s.implicit[i, j]) * slopes[j]
                if pushes[j] is not None and s.explicit[i, j]:
                    r += (h * s.explicit[i, j]) * pushes[j]
            at = t + h * s.nodes[i]
            if self.newton is None:
                y = resolvent.solve(r)
            else:
                y = self.newton(r, now.y, at, h * s.gamma, known[i - 1])
            _refuse_blown(system, y, at)
            now = self._ended(y, at, force[i - 1], held[i - 1], known[i - 1])
            stages.append(y)
            slopes.append(now.slope)
            pushes.append(now.pushed)
        if self.closes:
            y = y + system.settled(h).solve(h * sum(w * q for w, q in zip(s.closing, pushes)))
            now = self._ended(y, t + h, force[-1], held[-1], known[-1])
            stages.append(y)
        now.stages = stages
        if estimate and s.embedded is not None:
            gap = s.weights - s.embedded
            r = h * sum(g * (p if q is None else p + q) for g, p, q in zip(gap, slopes, pushes))
            error = resolvent.solve(r)
            now.error = error + SOON * (error - resolvent.solve(system.mass(error)))
        return now


class RadauStepper:
    """Steps of Radau IIA for linear problems: a real factor and a complex one."""

    order = 5

    def __init__(self, system: System, drive: Drive):
        self.system, self.drive = system, drive
        self.still = system.undriven()

    def smallest(self, h: float) -> float:
        """The step of backward Euler that its real factor serves."""
        return h / float(RADAU.values[0].real)

    def first(self, y: np.ndarray, t: float) -> Step:
        force, held, known = self.drive.start(t)
        slope = force - self.system.stiff(y)
        slope[self.still] = 0.0
        return Step(y, force, held, known, slope, None)

    def advance(self, last: Step, t: float, h: float, estimate: bool = False) -> Step:
        """With Z_i = Y_i - y:  E Z_i + H_i - H = h sum_j a_ij (F_j - A Y_j), decoupled by the eigenvectors."""
        r, system = RADAU, self.system
        real, pair = float(r.values[0].real), complex(r.values[1])
        force, held, known = self.drive.step(t, h)
        jumps = held - last.held
        stiff = force - system.stiff(last.y)
        # (inverse(a) / h) (E Z + jumps) + A Z = F - A y, in the coordinates of the eigenvectors
        right = stiff - np.tensordot(np.linalg.inv(r.matrix) / h, jumps, axes=1)
        turned = np.tensordot(r.back, right, axes=1)
        z0 = system.resolvent(h / real).solve((h / real) * turned[0].real)
        z1 = system.resolvent(h / pair).solve((h / pair) * turned[1])
        z = np.multiply.outer(r.vectors[:, 0].real, z0) + 2.0 * np.multiply.outer(r.vectors[:, 1], z1).real
        y = last.y + z[-1]
        _refuse_blown(system, y, t + h)
        slope = force[-1] - system.stiff(y)
        slope[self.still] = 0.0
        now = Step(y, force[-1], held[-1], known[-1], slope, None, [last.y + v for v in z])
        if estimate:
            now.error = self._error(last, t, h, z, np.array([system.mass(v) for v in z]) + jumps)
        return now

    def _error(self, last: Step, t: float, h: float, z: Any, moved: Any) -> np.ndarray:
        """The error e' = Z e + d that d, left over in a step by the polynomial through its stages, makes, Z = -h A / E.

        d = (t - c_1)(t - c_2)(t - c_3) q, so that e = MEAN (Z^2 q / 2 - Z q' + q'' / 2) to the order of the scheme and
        one more, and -d' / Z^2 at the end where Z is large: Z^2 is taken with two factors 1 / |1 - g Z|^2, which do
        both. What moves on and on is not damped: there the real factor is one of them, for fast waves are wrong.
        """
        r, system = RADAU, self.system
        real, g = float(r.values[0].real), 1.0 / complex(r.values[1])
        drive: Any = self.drive  # of a run: nobody else asks for errors
        force = drive.between(t, h, r.between(not system.second))
        inside = [h * (system.stiff(last.y + w @ z) - f) for w, f in zip(r.lagrange[1:], force)]
        q, q1, q2 = np.tensordot(r.left, r.slopes @ moved + np.stack([-h * last.slope, *inside]), axes=1)
        factor = system.resolvent(h / complex(r.values[1]))
        x = factor.solve(0.5 * (q + q1 + q2) - g * q1).imag / g.imag
        if system.second:
            e = system.resolvent(h / real).solve(real * system.mass(x) + q2) - real * x
        else:
            e = factor.solve(system.mass(x) + g * q2).imag / g.imag
        return _MORE * _MEAN * e


def _refuse_blown(system: System, y: np.ndarray, t: float) -> None:
    if not np.isfinite(system.largest(y)):
        raise Stopped(f"the solution is no longer finite at t = {t:.6g}")
