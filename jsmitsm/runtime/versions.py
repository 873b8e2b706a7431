"""What is installed here, for a report of a fault."""

from __future__ import annotations

import os
import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from typing import TextIO

_NEEDED = ("jax", "jaxlib", "numpy", "scipy", "optax")
_EXTRAS = ("matplotlib", "meshio", "shapely", "pandas", "xarray", "pyamg", "pypardiso", "tqdm")


def show_versions(file: TextIO | None = None) -> None:
    """Print the versions of jsmitsm, Python and the libraries, the devices and the precision.

    Paste it into a report of a fault.

    Parameters
    ----------
    file : text file, optional
        Where to print, standard output if not given.

    Examples
    --------
    >>> import jsmitsm as js
    >>> js.show_versions()  # doctest: +ELLIPSIS
    jsmitsm      ...
    """
    import jax

    if not (file is None or hasattr(file, "write")):
        raise ValueError(f"file: expected a text file or None, got {file!r}; open(..., 'w') makes one")
    lines = [("jsmitsm", _version("jsmitsm")), ("python", sys.version.split()[0]), ("system", platform.platform())]
    lines += [("cores", str(os.cpu_count()))]
    lines += [(name, _version(name)) for name in _NEEDED + _EXTRAS]
    lines += [("devices", ", ".join(map(str, jax.devices())))]
    lines += [("float64", "on" if jax.config.read("jax_enable_x64") else "off (jax_enable_x64)")]
    print("\n".join(f"{name:12} {value}" for name, value in lines), file=file)


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "from its sources" if name == "jsmitsm" else "not installed"
