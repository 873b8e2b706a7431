"""A cloud of several regions, with copies of every particle of an interface, one for each region that meets there."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from jsmitsm.cloud.cloud import INTERIOR, Cloud, Groups, checked_groups, checked_normals, checked_points
from jsmitsm.runtime.arrays import Array, ArrayLike
from jsmitsm.runtime.errors import did_you_mean, some
from jsmitsm.runtime.tracers import is_traced, owned


class Normals(Mapping[str, Any]):
    """Unit normals (P, D) of every interface; read-only."""

    def __init__(self, normals: Mapping[str, Any]):
        self._normals = {name: owned(values) for name, values in normals.items()}

    def __getitem__(self, name: str) -> Any:
        return self._normals[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._normals)

    def __len__(self) -> int:
        return len(self._normals)

    def __repr__(self) -> str:
        return repr(self._normals)


@jax.tree_util.register_pytree_node_class
class RegionCloud(Cloud):
    """A cloud of several regions; made by ``js.regions``.

    ``cloud.region("a")`` is the cloud of one region, with outward normals.

    Attributes
    ----------
    points, groups, normals : array (N, D), mapping, array (N, D)
        As those of ``js.Cloud``. Interfaces are groups too, ``"a|b"``, of the
        copies of both sides; the normal of both is that from a to b.
    regions : mapping
        Maps a name to the particles of that region, in ascending order; every particle belongs to one.
    interfaces : mapping
        Maps ``"a|b"`` to the pairs (P, 2) of particles, first that in a. A particle where several
        interfaces meet is in several pairs, and one at the end of an interface may belong to a group of the outer
        boundary.
    interface_normals : mapping
        Maps ``"a|b"`` to the unit normals (P, D) of the pairs, from a to b.

    Examples
    --------
    >>> import jsmitsm as js
    >>> cloud = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
    >>> cloud.interfaces["a|b"], len(cloud.region("a"))
    (array([[4, 8]]), 5)
    """

    _fixed = (*Cloud._fixed, "regions", "interfaces", "interface_normals")

    def __init__(
        self,
        points: ArrayLike,
        groups: Mapping[str, ArrayLike],
        normals: ArrayLike,
        regions: Mapping[str, ArrayLike],
        interfaces: Mapping[str, ArrayLike],
        interface_normals: Mapping[str, ArrayLike],
    ):
        self.regions = Groups({name: np.sort(np.asarray(ids)) for name, ids in regions.items()})
        owner = np.full(len(np.asarray(points)), -1)
        for k, ids in enumerate(self.regions.values()):
            owner[ids] = k
        self.points: Array = checked_points(points, owner)
        self.groups = checked_groups(groups, len(self.points))
        self.normals: Array | None = checked_normals(normals, self.points, self.groups)
        self.interfaces = Groups({name: np.asarray(pairs) for name, pairs in interfaces.items()})
        self.interface_normals = Normals({name: np.asarray(n, float) for name, n in interface_normals.items()})
        self._spacing: float | None = None
        _check_pairs(self, owner)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__({**state, "interface_normals": Normals(state["interface_normals"])})

    @property
    def spacing(self) -> float:
        """The smallest distance between two particles of one region, found on the host."""
        if self._spacing is None:
            self._spacing = min(self.region(name).spacing for name in self.regions if len(self.regions[name]) > 1)
        return self._spacing

    def region(self, name: str) -> Cloud:
        """The cloud of one region: its particles in their order, with outward normals.

        Parameters
        ----------
        name : str
            Of the region.

        Returns
        -------
        Cloud
            Its groups those of the boundary and the interfaces that it touches.

        Raises
        ------
        ValueError
            For other names.

        Examples
        --------
        >>> import jsmitsm as js
        >>> len(js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125).region("a"))
        5
        """
        if name not in self.regions:
            known = list(self.regions)
            raise ValueError(f"region: {name!r} is none of the cloud's, {known}{did_you_mean(name, known)}")
        ids = self.regions[name]
        place = np.full(len(self), -1)
        place[ids] = np.arange(len(ids))
        groups = {g: place[members][place[members] >= 0] for g, members in self.groups.items()}
        groups = {g: members for g, members in groups.items() if g == INTERIOR or len(members)}
        inward = [ids[members] for g, members in groups.items() if g in self.interfaces and sides(g)[1] == name]
        sign = np.ones((len(self), 1))
        sign[np.concatenate([np.zeros(0, int), *inward])] = -1.0
        assert self.normals is not None
        new = object.__new__(Cloud)
        new.points, new.groups, new.cell_groups = self.points[ids], Groups(groups), Groups({})
        new.normals, new._spacing = (self.normals * sign)[ids], None
        new._shape = None if self._shape is None else self._shape[name]
        return new

    def replace(self, points: ArrayLike | None = None, normals: ArrayLike | None = None) -> Cloud:
        """The same groups with other points or normals (traced values welcome); copies move together.

        Parameters
        ----------
        points, normals : array_like (N, D), optional
            What is replaced.

        Returns
        -------
        RegionCloud
            A new one; this one stays.

        Raises
        ------
        ValueError
            For another number of particles.

        Examples
        --------
        >>> import jsmitsm as js
        >>> layers = js.regions({"a": (0.0, 0.5), "b": (0.5, 1.0)}, spacing=0.125)
        >>> layers.replace(points=2 * layers.points).spacing
        0.25
        """
        new = object.__new__(RegionCloud)
        if points is not None and np.shape(points) != self.points.shape:
            raise ValueError(
                f"points: shape {np.shape(points)} came, {self.points.shape} was expected; "
                "make another cloud for another number of particles"
            )
        new.groups, new.regions, new.interfaces = self.groups, self.regions, self.interfaces
        owner = _owner(self)
        new.points = self.points if points is None else checked_points(points, owner)
        new.normals = self.normals if normals is None else checked_normals(normals, new.points, self.groups)
        if normals is None:
            new.interface_normals = self.interface_normals
        else:
            new.interface_normals = Normals({name: _renewed(self, new.normals, name) for name in self.interfaces})
        new._spacing = None if points is not None else self._spacing
        if not is_traced(new.points):
            _check_pairs(new, owner)
        return new

    def __repr__(self) -> str:
        return f"RegionCloud({len(self)} particles in {self.dim}D, regions {self.regions!r}, groups {self.groups!r})"

    def tree_flatten(self):
        return (self.points, self.normals, dict(self.interface_normals)), (self.groups, self.regions, self.interfaces)

    @classmethod
    def tree_unflatten(cls, static, leaves):
        new = object.__new__(cls)
        points, normals, between = leaves
        new.points, new.normals, new.interface_normals = owned(points), owned(normals), Normals(between)
        new.groups, new.regions, new.interfaces = static
        new._spacing = None
        return new


def sides(name: str) -> tuple[str, str]:
    """The two regions of the interface "a|b"."""
    first, second = name.split("|")
    return first, second


def _owner(cloud: RegionCloud) -> np.ndarray:
    owner = np.full(len(cloud), -1)
    for k, ids in enumerate(cloud.regions.values()):
        owner[ids] = k
    return owner


def _renewed(cloud: RegionCloud, normals: Any, name: str) -> Any:
    """The normals of an interface's pairs once those of its particles are others; ends and junctions keep theirs."""
    first, old = cloud.interfaces[name][:, 0], cloud.interface_normals[name]
    own = np.isin(first, cloud.groups[name])[:, None]
    if is_traced(normals):
        return jax.numpy.where(own, normals[first], old)
    return np.where(own, np.asarray(normals)[first], old)


def _check_pairs(cloud: RegionCloud, owner: np.ndarray) -> None:
    """Every particle in a region, every copy in a pair with one at the same place."""
    if (owner < 0).any():
        raise ValueError(f"regions: particles {some(np.flatnonzero(owner < 0))} belong to no region; add them to one")
    names, points, paired = list(cloud.regions), np.asarray(cloud.points), np.zeros(len(cloud), bool)
    twice = np.concatenate([np.zeros(0, int), *cloud.regions.values()])
    if len(twice) != len(np.unique(twice)):
        at = np.flatnonzero(np.bincount(twice) > 1)
        raise ValueError(f"regions: particles {some(at)} belong to two regions; give each a copy there, and pair them")
    for name, pairs in cloud.interfaces.items():
        if name.count("|") != 1 or not set(name.split("|")) <= set(names):
            raise ValueError(f"interfaces: {name!r} does not name two of the regions {names}, as \"a|b\"")
        if len(pairs) and not (0 <= pairs.min() and pairs.max() < len(cloud)):
            raise ValueError(f"interfaces[{name!r}]: particle {pairs.max()} of a pair is none of the {len(cloud)}")
        if len(np.unique(pairs, axis=0)) < len(pairs):
            raise ValueError(f"interfaces[{name!r}]: a pair stands there twice; name each once")
        first, second = (names.index(side) for side in sides(name))
        apart = np.flatnonzero((points[pairs[:, 0]] != points[pairs[:, 1]]).any(axis=1))
        if len(apart):
            i, j = pairs[apart[0]]
            raise ValueError(
                f"interfaces[{name!r}]: {len(apart)} pair(s) of copies with unequal positions, first particles {i} at "
                f"{points[i]} and {j} at {points[j]}; copies stand at one point and move together"
            )
        wrong = (owner[pairs[:, 0]] != first) | (owner[pairs[:, 1]] != second)
        if wrong.any():
            raise ValueError(
                f"interfaces[{name!r}]: the pair {pairs[wrong][0]} is not one of a particle in {sides(name)[0]!r} and "
                f"one in {sides(name)[1]!r}, in this order"
            )
        paired[pairs] = True
    for name in cloud.interfaces:
        alone = [i for i in cloud.groups.get(name, ()) if not paired[i]]
        if alone:
            raise ValueError(
                f"interfaces[{name!r}]: unpaired particle(s) {some(alone)}, first at {points[alone[0]]}: a particle on "
                "an interface has a copy in each of its regions; add the pair, or take it out of the group"
            )
    order = np.lexsort(points.T)
    same = (np.diff(points[order], axis=0) == 0).all(axis=1)
    lost = [i for i in np.concatenate([order[:-1][same], order[1:][same]]) if not paired[i]]
    if lost:
        raise ValueError(
            f"interfaces: particle {lost[0]} at {points[lost[0]]} has a copy in another region but no pair with it; "
            "add the pair to the interface of the two regions"
        )
