"""The package's own exceptions, and the words in which others' are told."""

from __future__ import annotations

import difflib
import functools
import inspect
import math
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from types import TracebackType
from typing import Any, TypeVar

import jax
import numpy as np

_Function = TypeVar("_Function", bound=Callable[..., Any])
# What a user's function may raise when it is called.
IN_FUNCTIONS = (TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RecursionError)
# What a flag says, in words that no other one has, and where docs/symptoms.md explains it.
SYMPTOMS = {
    "of their range between neighbours": "roughness",
    "The global system is nearly singular": "singular",
    "Round-off may reach": "round-off",
    "contradict the equation": "contradiction",
    "grows inwards": "growth",
    "The part of the source": "source",
    "The coefficients of the operator change": "coefficients",
    "A coefficient of the highest derivatives jumps": "jumps",
    "amplify their neighbours' errors": "weak",
    "No function fits the equation": "misfit",
    "times diffusion between neighbours": "convection",
    "The operator has waves of": "waves",
    "are known to": "rounded",
    "Between the particles the equation is missed": "missed",
    "Between the particles boundary data": "data",
    "The equation is not the same": "seam",
    "changes its sign": "turned",
    "is infinite at x =": "poles",
    "are nearer to the boundary": "near-boundary",
    "do not settle in Newton's method": "unsettled",
    "do not reach their nearest neighbours": "unmet",
    "The estimated error is": "estimate",
    "No order reaches the tolerance": "tolerance",
    "The data may not balance": "balance",
    "do not resolve the kernel": "kernel",
    "where regions meet": "meeting",
    "The estimated error in time": "time",
    "The start changes within the spacing": "start",
    "Between neighbouring particles convection": "drift",
    "has the wrong sign": "sign",
    "free of divergence": "divergence",
    "anything of the pressure": "outlet",
    "are not resolved, or spurious": "modes",
    "shorter than four": "modes",
    "far from self-adjoint": "self-adjoint",
}
# What an error says, and its place on that page; else the page about the argument that it begins with, else that about
# the package that raised it. Names of arguments mean other things in pictures.
REFUSALS = {
    "js.meant": "branch",
    "data do not balance": "balance",
    "Newton's method": "newton",
    "too coarse for the shape": "coarse",
    "before the transform": "stencils",
    " GB for ": "memory",
    "no condition": "conditions",
    "takes one condition": "conditions",
    "is singular": "resonance",
    "do not determine the solution": "resonance",
}
PAGES = {
    "problems": "bcs constraint constraints field fields indices integral params pde periodic problem sources unknowns",
    "clouds": "a b bounds cloud groups hi holes jitter lo n normals points sdf shape spacing vertices",
    "regions": "interfaces lattice region regions shapes",
    "choosing": "basis_terms d depth formulation h kernel method order radius size stencils",
    "time": "damping save scheme steps t",
    "modes": "count mass near",
    "adaptivity": "make max_particles max_rounds quantity start",
    "gradients": "objective optimizer parameters",
    "pictures": "ax at mesh path polygon tags",
}
PACKAGES = {
    "adaptation": "adaptivity", "cloud": "clouds", "equation": "problems", "evolution": "time", "modes": "modes",
    "parallel": "parallel", "particle": "choosing", "show": "pictures", "tuning": "gradients",
}  # fmt: skip
_PLACE = re.compile(r" \(docs: [\w#/-]+\)")
_LONGEST = 200  # letters of a value that a message quotes


class TooCoarse(ValueError):
    """A spacing too large for the shape: with a smaller one it may do."""


class TooFine(ValueError):
    """A spacing too small for the size of the domain: with a larger one it may do."""


class SolveError(RuntimeError):
    """A solve that failed: a singular system, values that are not finite, no convergence.

    Parameters
    ----------
    message : str
        What went wrong and what to do.
    particles : sequence of int
        Those at fault.

    Attributes
    ----------
    particles : tuple of int
        The particles at fault, the worst first; empty where none can be named.

    Examples
    --------
    >>> str(SolveError("the system is singular at particle 3", particles=[3]))
    'the system is singular at particle 3'
    """

    def __init__(self, message: str, particles: Sequence[int] = ()) -> None:
        super().__init__(message)
        self.particles: tuple[int, ...] = tuple(int(i) for i in particles)


class SingularMatrix(SolveError):
    """A linear system without a unique finite solution; `unknowns` at fault, the worst first."""

    def __init__(self, message: str, unknowns: Any = ()) -> None:
        super().__init__(message)
        self.unknowns: tuple[int, ...] = tuple(int(i) for i in unknowns)


def explained(flags: Iterable[str]) -> list[str]:
    """Flags, each with the place in the documentation that says what helps.

    >>> explained(["The operator has waves of 2.1 particles a length."])
    ['The operator has waves of 2.1 particles a length. (docs: symptoms#waves)']
    """
    out = []
    for flag in flags:
        anchor = next((f"#{name}" for words, name in SYMPTOMS.items() if words in flag), "")
        out.append(flag if "(docs: " in flag else f"{flag} (docs: symptoms{anchor})")
    return out


class _Explaining:
    """``@explaining``: what this public function refuses ends with the place in the documentation that helps.

    A user's setting of how JAX promotes ranks is about arrays of the user's, and does not reach into it.

    Functions that stand in a user's residuals have it in their messages instead: there this would be one more frame
    between the user's line and what is recorded of it.
    """

    def __call__(self, function: _Function) -> _Function:
        @functools.wraps(function)
        def explained(*args: Any, **options: Any) -> Any:
            with self, _ranks_promoted():
                try:
                    return function(*args, **options)
                except TypeError:
                    _refuse_call(function, args, options)
                    raise

        return explained  # type: ignore[return-value]

    def __enter__(self) -> None: ...

    def __exit__(self, kind: Any, error: BaseException | None, trace: TracebackType | None) -> None:
        package = _package(trace)
        if isinstance(error, SolveError) or isinstance(error, (ValueError, ImportError)) and package is not None:
            error.args = (placed(str(error), package or ""), *error.args[1:])


explaining = _Explaining()


def _refuse_call(function: Callable[..., Any], args: tuple[Any, ...], options: dict[str, Any]) -> None:
    """Refuse in words arguments that a function has not, or lacks; nothing where it can be called so."""
    signature = inspect.signature(function)
    try:
        signature.bind(*args, **options)
    except TypeError as fault:
        name = type(args[0]).__name__ if function.__name__ == "__init__" else function.__qualname__
        known = [p.name for p in signature.parameters.values() if p.name != "self" and p.kind != p.VAR_KEYWORD]
        alien = next((option for option in options if option not in known), None)
        wrong = f"{name}: {fault}" if alien is None else f"{alien}: no argument of {name}{did_you_mean(alien, known)}"
        raise TypeError(f"{wrong}; it takes {', '.join(known) or 'nothing'}") from None


def _ranks_promoted() -> AbstractContextManager[Any]:
    """Nothing where that is so: entering JAX's own would make programs of their own."""
    asked = jax.config.jax_numpy_rank_promotion  # type: ignore[attr-defined]
    return nullcontext() if asked == "allow" else jax.numpy_rank_promotion("allow")


def _package(trace: TracebackType | None) -> str | None:
    """The package in which an error was raised; None in a user's function or another library."""
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    of, _, rest = ("" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))).partition(".")
    return rest.partition(".")[0] if of == "jsmitsm" else None


def placed(message: str, package: str = "") -> str:
    """An error's message that ends with the place in the documentation; a message quoted in it may have one already.

    >>> placed("pde: expected a function, got 3"), placed("tol: expected a number")
    ('pde: expected a function, got 3 (docs: problems)', 'tol: expected a number (docs: symptoms#errors)')
    >>> placed("count: 1 is too few", "show"), placed("pde: fails: the order is 3 (docs: time); write 2")
    ('count: 1 is too few (docs: pictures)', 'pde: fails: the order is 3; write 2 (docs: time)')
    """
    if inner := _PLACE.search(message):
        return _PLACE.sub("", message) + inner[0]
    if place := next((f"symptoms#{name}" for words, name in REFUSALS.items() if words in message), None):
        return f"{message} (docs: {place})"
    argument = re.match(r"\w*", message)
    asked = argument[0] if argument and package != "show" else ""
    known = next((page for page, names in PAGES.items() if asked in names.split()), None)
    return f"{message} (docs: {known or PACKAGES.get(package, 'symptoms#errors')})"


def some(index: Any, most: int = 6) -> str:
    """A short list of particle numbers (n,) for a message.

    >>> some([3, 1, 4], most=2)
    '[3, 1, ...]'
    """
    return f"[{', '.join(str(int(i)) for i in index[:most])}{', ...' if len(index) > most else ''}]"


def did_you_mean(name: Any, known: Iterable[str]) -> str:
    """The end of a message that refuses a name: the known one that is nearly the same, if there is one.

    >>> did_you_mean("lefft", ["left", "right"]), did_you_mean("Left", ["left"]), did_you_mean("far", ["left", "right"])
    ("; did you mean 'left'?", "; did you mean 'left'?", '')
    """
    came = str(name)  # an array would compare by its entries
    lower = {k.lower(): k for k in known if k != came}
    close = difflib.get_close_matches(came.lower(), lower, 1)
    return f"; did you mean {lower[close[0]]!r}?" if close else ""


def is_one_of(value: Any, known: Iterable[str]) -> bool:
    """Whether a value is one of these words; an array, which compares by its entries, is none.

    >>> import numpy as np
    >>> is_one_of("loo", ["loo", "lsq"]), is_one_of(np.zeros(2), ["loo", "lsq"])
    (True, False)
    """
    return isinstance(value, str) and value in known


def refuse_word(name: str, value: Any, known: Iterable[str]) -> None:
    """Refuse what is none of these words.

    >>> refuse_word("norm", "mx", ["max", "rms"])
    Traceback (most recent call last):
      ...
    ValueError: norm: 'mx' is none of 'max', 'rms'; did you mean 'max'?
    """
    if not is_one_of(value, known):
        raise ValueError(f"{name}: {short(value)} is none of {', '.join(map(repr, known))}{did_you_mean(value, known)}")


def refuse_no_switch(name: str, value: Any) -> None:
    """Refuse what is neither True nor False: of "no" and of arrays Python would say that they are true, or nothing.

    >>> refuse_no_switch("log", "no")
    Traceback (most recent call last):
      ...
    ValueError: log: expected True or False, got 'no'
    """
    if not isinstance(value, (bool, np.bool_)):
        raise ValueError(f"{name}: expected True or False, got {short(value)}")


def short(value: Any) -> str:
    """A value as a message quotes it, a traced one in words.

    >>> short(10**400), short([1, 2])
    ('a whole number of 401 digits', '[1, 2]')
    """
    if isinstance(value, int) and value.bit_length() > 128:
        return f"a whole number of {int(value.bit_length() * 0.30103) + 1} digits"
    try:
        text = _without_tracers(repr(value))
    except ValueError:  # whole numbers of thousands of digits within
        return f"a {type(value).__name__} of numbers without end"
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def _without_tracers(text: str) -> str:
    return re.sub(r"'?\b\w*Tracer\b'?(\([^()]*\)|<[^<>]*>| object)?", "a traced array", text)


def in_words(error: Exception) -> str:
    """What went wrong in a user's function, with the remedy where the message of Python or JAX has none."""
    text = _without_tracers(str(error))
    if isinstance(error, jax.errors.ConcretizationTypeError | jax.errors.TracerArrayConversionError):
        return (f"{text.splitlines()[0].rstrip('.')}. It must be written in jax.numpy: jnp.sin for np.sin or math.sin, "
                "jnp.where for an if")  # fmt: skip
    if isinstance(error, IndexError):
        return (f"{text}; x is one point of shape (D,), x[0] its first coordinate; u(x) is a number, and a vector (F,) "
                "with js.Problem(..., fields=F)")  # fmt: skip
    if isinstance(error, KeyError):
        return f"nothing is called {text} in what it was given; its names are those of params and unknowns"
    if isinstance(error, OverflowError):
        return ("a number too large for floats, which end at 1.8e308, or for whole numbers of 64 bits; write large "
                "ones as floats (1e20 for 10**20), and divide the equation by a number of their size")  # fmt: skip
    if isinstance(error, RecursionError):
        return (f"functions within functions beyond Python's limit of {sys.getrecursionlimit()} calls; write a sum or "
                "a loop in one function in place of closures in each other, or call sys.setrecursionlimit")  # fmt: skip
    if isinstance(error, AttributeError) and error.name is not None:
        return f"{text}{did_you_mean(error.name, dir(error.obj))}"
    if isinstance(error, TypeError) and re.match(r"(grad|laplacian|divergence|hessian|partial|dt)\(\) takes", text):
        return f"{text}; an operator makes a function of the point: js.laplacian(u)(x)"
    if isinstance(error, TypeError) and "'function' object is not subscriptable" in text:
        return (f"{text}; a plain function has no components u[k]: write js.laplacian(u)(x)[k] for "
                "js.laplacian(u[k])(x), which serves fields and functions alike")  # fmt: skip
    return text


def of_the_pde(error: Exception) -> str:
    """What went wrong when a user's equation was called."""
    text = in_words(error)
    return text if text.startswith("pde") else f"pde: {text}; a pde returns a number, or one for each equation"


def refuse_masked(value: Any, name: str) -> None:
    """Refuse a masked array with masked entries: as an ordinary array it would show what the mask hides.

    >>> import numpy as np
    >>> refuse_masked(np.ma.array([1.0, 2.0], mask=[False, True]), "points")
    Traceback (most recent call last):
      ...
    ValueError: points: 1 of its 2 entries are masked, as [1]; fill them (np.ma.filled) or drop them
    """
    if np.ma.isMaskedArray(value) and (hidden := np.ma.getmaskarray(value)).any():
        first = np.argwhere(hidden)[0].tolist()
        raise ValueError(
            f"{name}: {hidden.sum()} of its {hidden.size} entries are masked, as {first}; fill them (np.ma.filled) or "
            "drop them"
        )


def numbers(name: str, value: Any) -> np.ndarray:
    """A value as an array of floats, refused in words where it is none.

    >>> numbers("parameters", "ab")
    Traceback (most recent call last):
      ...
    ValueError: parameters: expected numbers, got 'ab'
    """
    try:
        # Dates, texts and None would become floats.
        if np.asarray(value).dtype.kind in "biufO" and value is not None:
            return np.asarray(value, float)
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"{name}: expected numbers, got {short(value)}")


def listed(name: str, value: Any, expected: str) -> list[Any]:
    """What stands in a sequence, refused in words where it is none.

    >>> listed("holes", 3, "polygons")
    Traceback (most recent call last):
      ...
    ValueError: holes: expected polygons, in a list, got 3
    """
    try:
        return list(value)
    except TypeError:
        raise ValueError(f"{name}: expected {expected}, in a list, got {short(value)}") from None


def is_whole(value: Any, least: float = -np.inf, most: float = np.inf) -> bool:
    """Whether a value is a whole number of this range; True, False and a span of time are none."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.timedelta64))
    return whole and bool(least <= value <= most)


def is_number(value: Any) -> bool:
    """Whether a value is a finite real number; True, False and a span of time are none."""
    no_number = (bool, np.complexfloating, np.timedelta64)
    real = isinstance(value, (int, float, np.number)) and not isinstance(value, no_number)
    try:
        return real and math.isfinite(value)
    except OverflowError:  # a whole number beyond all floats
        return False
