"""Particles, their groups and normals, and clouds on lattices."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jsmitsm.runtime import notebooks
from jsmitsm.runtime.arrays import Array, ArrayLike
from jsmitsm.runtime.errors import explaining, refuse_masked, some
from jsmitsm.runtime.tracers import frozen, is_traced, owned

INTERIOR = "interior"
# Coordinates beyond this, or all below its inverse, have powers that are no numbers.
FAR = 1e100
# What follows from the particles is kept with a cloud of up to so many, for so many different questions.
_LARGEST_KEPT, _MOST_KEPT = 100_000, 12


class Groups(Mapping[str, np.ndarray]):
    """Named, disjoint sets of particles; immutable and hashable, so it can be static under jit."""

    def __init__(self, groups: Mapping[str, np.ndarray]):
        self._groups: dict[str, np.ndarray] = {}
        for name, index in groups.items():
            index = np.array(index, dtype=np.int64)
            index.setflags(write=False)
            self._groups[name] = index
        self._key = tuple((name, index.tobytes()) for name, index in self._groups.items())

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        for index in self._groups.values():
            index.setflags(write=False)

    def __getitem__(self, name: str) -> np.ndarray:
        return self._groups[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._groups)

    def __len__(self) -> int:
        return len(self._groups)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Groups) and self._key == other._key

    def __repr__(self) -> str:
        return "{" + ", ".join(f"{name}: {len(index)}" for name, index in self.items()) + "}"


@jax.tree_util.register_pytree_node_class
class Cloud:
    """A cloud of particles with named groups.

    Parameters
    ----------
    points : array_like (N, D)
        (N, D) float array, D = 1, 2 or 3 (also in 1D), in length units.
    groups : mapping
        Maps a name to an integer index array. The groups are disjoint and cover every particle; ``"interior"`` is
        one of them, every other one is a boundary group.
    normals : array_like (N, D), optional
        (N, D) unit outward normals, NaN in the interior. Needed only where a boundary condition uses them.
    cell_groups : mapping, optional
        Maps a name to an integer index array, as the materials of a mesh do: these may overlap (a particle between
        two materials belongs to both) and need not cover the cloud. No condition refers to them.

    Raises
    ------
    ValueError
        For a wrong shape, NaN, overlapping or incomplete groups, duplicate particles.

    Notes
    -----
    A cloud is a pytree: points and normals are leaves, groups and cell groups are static. It does not change: its
    arrays are read-only copies, and ``replace`` makes another one.

    Examples
    --------
    >>> import numpy as np, jsmitsm as js
    >>> cloud = js.Cloud(
    ...     np.array([[0.0], [0.5], [1.0]]), {"interior": [1], "ends": [0, 2]}
    ... )
    >>> len(cloud), cloud.spacing
    (3, 0.5)
    """

    cell_groups = Groups({})  # also of clouds pickled before there were any
    _fixed: tuple[str, ...] = ("points", "groups", "normals", "cell_groups")
    _shape: Any = None  # what the particles fill, where their maker knows it: pictures end there

    @explaining
    def __init__(
        self,
        points: ArrayLike,
        groups: Mapping[str, ArrayLike],
        normals: ArrayLike | None = None,
        cell_groups: Mapping[str, ArrayLike] | None = None,
    ):
        self.points: Array = checked_points(points)
        self.groups = checked_groups(groups, len(self.points))
        self.normals: Array | None = checked_normals(normals, self.points, self.groups)
        self.cell_groups = _checked_cell_groups(cell_groups, len(self.points))
        self._spacing: float | None = None

    def __setattr__(self, name: str, value: Any) -> None:
        # What was solved on a cloud rests on it.
        if name in self._fixed and name in self.__dict__:
            way = f"cloud.replace({name}=...)" if name in ("points", "normals") else "make another one"
            raise AttributeError(f"{name}: a {type(self).__name__} does not change; {way}")
        object.__setattr__(self, name, value)

    def __getstate__(self) -> dict[str, Any]:
        made_again = ("_inside", "_kept", "_shape")  # when needed, or looked at by pictures alone
        return {name: value for name, value in self.__dict__.items() if name not in made_again}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update({name: frozen(value) for name, value in state.items()})

    @property
    def dim(self) -> int:
        """Number of space dimensions D."""
        return self.points.shape[1]

    @property
    def spacing(self) -> float:
        """The smallest distance between two particles, found on the host."""
        if self._spacing is None:
            if isinstance(self.points, jax.core.Tracer):
                raise ValueError(
                    "cloud.spacing: the points are traced by a JAX transform, and the smallest distance "
                    "is found on the host; take cloud.spacing before the transform and pass the number in"
                )
            from scipy.spatial import cKDTree

            points = np.asarray(self.points)
            if len(points) < 2:
                raise ValueError("cloud.spacing: a distance needs at least two particles, the cloud has 1; add some")
            self._spacing = float(cKDTree(points).query(points, k=2)[0][:, 1].min())
        return self._spacing

    @property
    def boundary(self) -> np.ndarray:
        """Indices of all particles that are not in the interior, ascending."""
        return np.setdiff1d(np.arange(len(self)), self.groups[INTERIOR])

    @explaining
    def replace(self, points: ArrayLike | None = None, normals: ArrayLike | None = None) -> Cloud:
        """The same groups with other points or normals (traced values welcome).

        Parameters
        ----------
        points, normals : array_like (N, D), optional
            What is replaced.

        Returns
        -------
        Cloud
            A new one; this one stays.

        Raises
        ------
        ValueError
            For another number of particles.

        Examples
        --------
        >>> import jsmitsm as js
        >>> rod = js.interval(0.0, 1.0, 5)
        >>> rod.replace(points=2 * rod.points).spacing
        0.5
        """
        new = object.__new__(Cloud)
        if points is not None and np.shape(points) != self.points.shape:
            raise ValueError(
                f"points: shape {np.shape(points)} came, {self.points.shape} was expected; "
                "build a new Cloud for another number of particles"
            )
        new.points = self.points if points is None else checked_points(points)
        new.groups = self.groups
        new.cell_groups = self.cell_groups
        new.normals = self.normals if normals is None else checked_normals(normals, new.points, self.groups)
        new._spacing = None if points is not None else self._spacing
        return new

    def __len__(self) -> int:
        return self.points.shape[0]

    def __repr__(self) -> str:
        cells = f", cell groups {self.cell_groups!r}" if self.cell_groups else ""
        return f"Cloud({len(self)} particles in {self.dim}D, groups {self.groups!r}{cells})"

    def _repr_html_(self) -> str:
        if is_traced(self.points):
            return repr(self)
        points, kind = np.asarray(self.points), np.zeros(len(self))
        for k, index in enumerate(index for name, index in self.groups.items() if name != INTERIOR):
            kind[index] = k + 1
        box = " x ".join(notebooks.span(axis) for axis in points.T)
        counted = [(name, f"{len(index)} particles") for name, index in self.groups.items()]
        title = f"{type(self).__name__}: {len(self)} particles in {self.dim}D"
        return notebooks.shown(title, [("box", box), *counted], notebooks.dots(points, kind, len(self.groups)))

    def tree_flatten(self):
        return (self.points, self.normals), (self.groups, self.cell_groups)

    @classmethod
    def tree_unflatten(cls, static, leaves):
        new = object.__new__(cls)
        new.points, new.normals = map(owned, leaves)
        new.groups, new.cell_groups = static
        new._spacing = None
        return new


def checked_points(points: Any, label: np.ndarray | None = None) -> Any:
    """Points as a float array (N, D); a traced array passes through. Points of two labels (N,) may coincide."""
    if isinstance(points, jax.core.Tracer):
        shape = points.shape
    else:
        refuse_masked(points, "points")
        try:
            array = np.asarray(points)
            if array.dtype.kind not in "fiu":
                raise TypeError
        except (TypeError, ValueError, OverflowError):
            raise ValueError(
                f"points: expected a real array of shape (N, D), got {type(points).__name__} "
                "that is not one; pass e.g. np.array([[0.0, 0.0], [1.0, 0.0]])"
            ) from None
        points = array.astype(np.float32 if array.dtype == np.float32 else np.float64)  # a copy: the user's may change
        shape = points.shape
    if len(shape) != 2 or shape[1] not in (1, 2, 3) or shape[0] == 0:
        hint = "; in 1D use points[:, None]" if len(shape) == 1 else ""
        raise ValueError(f"points: expected shape (N, D) with D = 1, 2 or 3, got {shape}{hint}")
    if isinstance(points, np.ndarray):
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise ValueError(f"points: NaN or infinite coordinates at particles {some(bad, most=8)}; remove them")
        size = float(abs(points).max())
        if size > FAR or 0.0 < size < 1.0 / FAR:
            raise ValueError(
                f"points: coordinates of size {size:.0e}, whose powers leave the range of floats; use another unit of "
                "length"
            )
        keys = points.T if label is None else [*points.T, label]
        order = np.lexsort(keys)
        same = np.flatnonzero(np.all([np.diff(np.asarray(key)[order]) == 0 for key in keys], axis=0))
        if len(same):
            pairs = [(int(order[k]), int(order[k + 1])) for k in same[:5]]
            raise ValueError(
                f"points: {len(same)} duplicate particles, pairs {pairs}; keep one of each (np.unique(points, axis=0))"
            )
    return frozen(points)


def checked_groups(groups: Mapping[str, Any], n: int) -> Groups:
    """Disjoint groups that cover all n particles."""
    if not isinstance(groups, Mapping) or INTERIOR not in groups:
        raise ValueError(
            f'groups: expected a dict of index arrays with a key "interior", got {_describe_groups(groups)}'
        )
    owner = np.full(n, -1)
    checked = {}
    for k, (name, index) in enumerate(groups.items()):
        _check_name("groups", name)
        index = _checked_index(f"groups[{name!r}]", index, n)
        once, count = np.unique(index, return_counts=True)
        taken = once[(owner[once] >= 0) | (count > 1)]
        if len(taken):
            raise ValueError(
                f"groups[{name!r}]: particles {some(taken, most=8)} are in two groups or twice "
                "in one; every particle belongs to exactly one group"
            )
        owner[index] = k
        checked[name] = index
    missing = np.flatnonzero(owner < 0)
    if len(missing):
        raise ValueError(
            f"groups: particles {some(missing, most=8)} belong to no group; add them to one, e.g. 'interior'"
        )
    return Groups(checked)


def _checked_cell_groups(groups: Any, n: int) -> Groups:
    """Named sets of particles that may overlap."""
    if not isinstance(groups, Mapping) and groups is not None:
        raise ValueError(f"cell_groups: expected a dict of index arrays, got {type(groups).__name__}")
    checked = {}
    for name, index in (groups or {}).items():
        _check_name("cell_groups", name)
        checked[name] = np.unique(_checked_index(f"cell_groups[{name!r}]", index, n))
    return Groups(checked)


def _check_name(what: str, name: Any) -> None:
    if not isinstance(name, str):
        raise ValueError(f"{what}: the name {name!r} of a group is no string; write e.g. {str(name)!r}")


def _checked_index(what: str, index: Any, n: int) -> np.ndarray:
    """Indices of particles (K,)."""
    refuse_masked(index, what)
    try:
        index = np.asarray(index)
        if index.size == 0:
            index = index.astype(np.int64).reshape(-1)
        if index.ndim != 1 or index.dtype.kind not in "iu":
            raise ValueError
    except ValueError:
        came = f"{index.dtype} of shape {index.shape}" if isinstance(index, np.ndarray) else f"{index!r}"
        raise ValueError(
            f"{what}: expected a 1D integer index array, got {came}; turn a mask into indices with np.flatnonzero"
        ) from None
    if index.size and (index.min() < 0 or index.max() >= n):
        raise ValueError(
            f"{what}: indices from {index.min()} to {index.max()}, expected 0 to {n - 1} for {n} particles"
        )
    return index


def checked_normals(normals: Any, points: Any, groups: Groups) -> Any:
    """Unit normals at the boundary, NaN inside; None and traced arrays pass through."""
    if normals is None:
        return None
    if np.shape(normals) != points.shape:
        raise ValueError(f"normals: expected shape {points.shape} like points, got {np.shape(normals)}")
    if isinstance(normals, jax.core.Tracer):
        return normals
    if np.ma.isMaskedArray(normals):  # what is masked has none, as the interior
        normals = np.ma.filled(normals.astype(np.float64), np.nan)
    try:
        normals = np.asarray(normals)
        if normals.dtype.kind == "c":
            raise TypeError
        normals = normals.astype(np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError("normals: expected real numbers, unit vectors that point outward") from None
    normals[groups[INTERIOR]] = np.nan
    length = np.linalg.norm(normals, axis=1)
    bad = np.flatnonzero(np.abs(length - 1) > 1e-6)
    if len(bad):
        raise ValueError(
            f"normals: not of unit length at particles {some(bad, most=8)} (length {length[bad[0]]:.3g}); "
            "divide by np.linalg.norm(normals, axis=1, keepdims=True)"
        )
    return frozen(normals)


def _describe_groups(groups: Any) -> str:
    return f"keys {list(groups)}" if isinstance(groups, Mapping) else type(groups).__name__


def kept(cloud: Cloud, question: Hashable, answer: Callable[[], Any]) -> Any:
    """What ``answer()`` gives, or gave when it was last asked: it may rest on the question and on the cloud alone.

    The next solve on a cloud finds neighbours, supports and classes as they were. It must not change what it gets.
    """
    if len(cloud) > _LARGEST_KEPT or is_traced(cloud.points, cloud.normals):
        return answer()
    answers = cloud.__dict__.setdefault("_kept", {})
    found = answers.pop(question, None)
    found = answer() if found is None else found
    answers[question] = found  # the last one used stands last
    while len(answers) > _MOST_KEPT:
        answers.pop(next(iter(answers)), None)
    return found
