"""Mesh files: by meshio, SU2 and Abaqus by readers of our own, and nothing that was misread is passed on."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import warnings
from typing import Any

from jsmitsm.show.abaqus import read_abaqus
from jsmitsm.show.su2 import read_su2

# meshio loses the names of SU2's markers and misreads tabs; of Abaqus it mixes up sets and keeps one block of nodes.
_OWN = {".su2": read_su2, ".inp": read_abaqus}
# What meshio prints and a cloud does not need: the partitions of a Gmsh mesh.
_HARMLESS = ("tag data that couldn't be processed",)
# Where lines of these are missing meshio looks for them for ever.
_BY_LINES = {".dat": "tecplot", ".tec": "tecplot", ".mdpa": "mdpa"}
_TETGEN = (".node", ".ele")  # one mesh in two files


def needed(name: str, extra: str) -> Any:
    """An optional library, or an error that names its extra."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise ImportError(f'{name} is needed here, an optional extra: pip install "jsmitsm[{extra}]"') from None


def read_mesh(path: Any) -> Any:
    """The mesh in a file; whatever meshio does with one that is damaged, which may be to end the program."""
    name = os.fsdecode(path)
    extension = os.path.splitext(name)[1].lower()
    meshio = None if extension in _OWN else needed("meshio", "mesh")
    kind = _checked_kind(name, extension)
    for part in _TETGEN if extension in _TETGEN else ():
        _checked_kind(os.path.splitext(name)[0] + part, part)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), warnings.catch_warnings():
            # numpy stops at what is no number, and meshio goes on with what came before.
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message=".*could not be read to its end")
            if meshio is None:
                mesh = _OWN[extension](name)
            elif extension in _BY_LINES:
                mesh = _read_by_lines(meshio, name, _BY_LINES[extension])
            else:
                mesh = meshio.read(name, kind)
    except ModuleNotFoundError as error:
        raise ImportError(f"mesh: meshio needs {error.name} for {name!r}: pip install {error.name}") from None
    except (Exception, SystemExit) as error:
        # meshio prints its words and ends the program with a number.
        what = f"{type(error).__name__}: {error}".strip(": ")
        words = " ".join([what, *said.getvalue().split()])
        raise ValueError(
            f"mesh: cannot read {name!r} ({words}){_hint(what)}; expected a whole file of a format that its extension "
            "names (.msh, .vtk, .vtu, .inp, .su2, .xdmf, ...)"
        ) from error
    doubts = [line for line in said.getvalue().splitlines() if line.strip()]
    if doubts and not any(word in said.getvalue() for word in _HARMLESS):
        raise ValueError(
            f"mesh: the file {name!r} was read in part only: {' '.join(' '.join(doubts).split())}; write it without "
            "what meshio does not know, or in another format"
        )
    return mesh


class _Ending:
    """A file that refuses to be read far beyond its end; a few empty lines there tell a reader that it has ended."""

    _beyond = 0

    def readline(self, *size: Any) -> Any:
        line = super().readline(*size)  # type: ignore[misc]
        self._beyond += not line
        if self._beyond > 9:
            raise EOFError("it is cut short")
        return line


class _Lines(_Ending, io.TextIOWrapper): ...  # type: ignore[misc]


class _Bytes(_Ending, io.BufferedReader): ...  # type: ignore[misc]


def _read_by_lines(meshio: Any, name: str, kind: str) -> Any:
    file = _Bytes(io.FileIO(name))
    with file if kind == "mdpa" else _Lines(file) as lines:
        return meshio.read(lines, kind)


def _checked_kind(name: str, extension: str) -> str | None:
    """Which of the two formats of .msh a file has; refuse a file that is empty or ends too soon."""
    if not os.path.isfile(name):
        raise ValueError(f"mesh: there is no file {name!r}; give the path of a mesh file")
    if extension == ".wkt":
        raise ValueError(f"mesh: {name!r}: meshio may search a damaged WKT for ever; write the mesh as .msh, .vtk or "
                         ".vtu, and give the text of a polygon to js.files.from_shapely")  # fmt: skip
    with open(name, "rb") as file:
        start = file.read(1)
        file.seek(-min(os.path.getsize(name), 100), os.SEEK_END)
        end = file.read().split()
        if extension in _TETGEN:  # comments alone are nothing either
            file.seek(0)
            end = [line for line in file if not line.strip().startswith(b"#") and line.strip()]
    kind = {b"$": "gmsh", b"(": "ansys"}.get(start) if extension == ".msh" else None
    # Of such a file that ends too soon, or is of neither kind, meshio would look for the end for ever.
    whole = end and (end[-1].startswith(b"$End") if kind == "gmsh" else end[-1].endswith(b")") or kind != "ansys")
    if not whole:
        raise ValueError(f"mesh: the file {name!r} is {'cut short' if end else 'empty'}; write it again")
    if kind is None and extension == ".msh":
        raise ValueError(f"mesh: the file {name!r} is of neither kind of .msh, Gmsh's or Ansys's; convert it")
    return kind


def _hint(what: str) -> str:
    """A remedy for what meshio cannot do."""
    if "Incompatible cell data 'gmsh:physical'" in what:
        return ": some of its entities are in no physical group; save the physical groups alone (Mesh.SaveAll = 0)"
    return ": meshio does not know that kind of cell" if what.startswith("KeyError") else ""
