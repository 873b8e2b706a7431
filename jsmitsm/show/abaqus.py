"""Meshes of Abaqus and CalculiX (.inp), with their sets of nodes and elements and their surfaces."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator

import numpy as np

from jsmitsm.cloud.mesh_facets import Block, Mesh, dimension

_SOLID = re.compile(r"C3D(\d+)")
_PLANE = re.compile(r"^(?:CPS|CPE|CPEG|CAX|CGAX|DC2D|DCAX|AC2D|ACAX|M3D|SFM3D|STRI|R3D|DS|S)(\d)")
_LINE = re.compile(r"^(?:T2D|T3D|R2D|RAX|DC1D|AC1D)(\d)")
_BEAMS = {"B21": 2, "B22": 3, "B23": 2, "B31": 2, "B32": 3, "B33": 2}
_KINDS = {3: {4: "tetra", 5: "pyramid", 6: "wedge", 8: "hexahedron", 10: "tetra10", 13: "pyramid13", 15: "wedge15",
              20: "hexahedron20", 27: "hexahedron27"},
          2: {3: "triangle", 4: "quad", 6: "triangle6", 8: "quad8", 9: "quad9"},
          1: {2: "line", 3: "line3"}}  # fmt: skip
# The faces S1, S2, ... by corners; beyond these a side has the name of its number.
_FACES = {"triangle": ["01", "12", "20"], "quad": ["01", "12", "23", "30"], "tetra": ["012", "031", "132", "230"],
          "hexahedron": ["0123", "4765", "0154", "1265", "2376", "3047"],
          "wedge": ["012", "354", "0143", "1254", "2035"], "pyramid": ["0123", "014", "124", "234", "304"]}  # fmt: skip


class _Deck:
    """What was read: nodes and elements by the file's numbers, sets by name (in capitals)."""

    def __init__(self) -> None:
        self.nodes: dict[int, list[float]] = {}
        self.kinds: dict[int, str] = {}
        self.elements: dict[int, list[int]] = {}
        self.sets: dict[tuple[str, str], list[int]] = {}
        self.names: dict[tuple[str, str], str] = {}
        self.surfaces: dict[str, list[tuple[str, str]]] = {}

    def members(self, kind: str, name: str, words: list[str]) -> None:
        """Add members to a set: numbers, or the names of sets."""
        self.names.setdefault((kind, name.upper()), name)
        into = self.sets.setdefault((kind, name.upper()), [])
        for word in words:
            if re.fullmatch(r"[+-]?\d+", word):
                into.append(int(word))
            elif (kind, word.upper()) in self.sets:
                into.extend(self.sets[kind, word.upper()])
            else:
                raise ValueError(f"the set {name!r} names {word!r}, which is neither a number nor a set before it")


def read_abaqus(path: str) -> Mesh:
    """The mesh of one part; its sets are point and cell sets, its surfaces too."""
    deck = _Deck()
    instances = 0
    for card, options, rows in _cards(path):
        if card == "NODE":
            _read_nodes(deck, options, rows)
        elif card == "ELEMENT":
            _read_elements(deck, options, rows)
        elif card in ("NSET", "ELSET"):
            _read_set(deck, card, options, rows)
        elif card == "SURFACE" and options.get("TYPE", "ELEMENT").upper() == "ELEMENT":
            faces = [(row[0], row[1].upper() if len(row) > 1 else "") for row in rows]
            deck.surfaces.setdefault(options.get("NAME", ""), []).extend(faces)
        elif card == "INSTANCE":
            instances += 1
            if instances > 1 or any(rows):
                raise ValueError("it has several instances, or one that is moved; write one flat mesh of them")
    if not deck.nodes or not deck.elements:
        raise ValueError("it has no *NODE or no *ELEMENT")
    return _mesh(deck)


def _cards(path: str, depth: int = 0) -> Iterator[tuple[str, dict[str, str], list[list[str]]]]:
    """The keyword, its options and its rows of words, one keyword after the other; included files in their place."""
    with open(path, encoding="utf-8", errors="replace") as file:
        lines = [line.strip() for line in file if line.strip() and not line.startswith("**")]
    k = 0
    while k < len(lines):
        head = lines[k]
        k += 1
        if not head.startswith("*"):
            continue  # a title, or what stands before the first keyword
        while head.endswith(",") and k < len(lines):
            head, k = head + lines[k], k + 1
        words = [word.strip() for word in head[1:].split(",")]
        options = {key.strip().upper(): value.strip() for key, _, value in (word.partition("=") for word in words[1:])}
        rows = []
        while k < len(lines) and not lines[k].startswith("*"):
            rows.append([word.strip() for word in lines[k].split(",")])
            k += 1
        card = words[0].upper()
        if not re.fullmatch(r"[A-Z][A-Z0-9 _-]*", card):
            raise ValueError(f"the line {head[:60]!r} has no keyword; expected one, as *NODE, and options after commas")
        if card == "INCLUDE":
            if depth > 8:
                raise ValueError(f"the file {path!r} is included by itself")
            yield from _cards(os.path.join(os.path.dirname(path), options.get("INPUT", "").strip('"')), depth + 1)
        else:
            yield card, options, rows


def _read_nodes(deck: _Deck, options: dict[str, str], rows: list[list[str]]) -> None:
    if options.get("SYSTEM", "R").upper() != "R":
        raise ValueError(f"its nodes are in the system {options['SYSTEM']!r}; write them in x, y and z")
    new = {}
    for row in rows:
        number = int(row[0])
        if number in deck.nodes or number in new:
            raise ValueError(f"the node {number} comes twice, as in a file of several parts; write one flat mesh")
        new[number] = [float(word) if word else 0.0 for word in (row[1:4] + ["", ""])[:3]]
    deck.nodes |= new
    if options.get("NSET"):
        deck.members("NSET", options["NSET"], [str(number) for number in new])


def _read_elements(deck: _Deck, options: dict[str, str], rows: list[list[str]]) -> None:
    kind, count = _kind(options.get("TYPE", ""))
    numbers = [int(word) for row in rows for word in row if word]
    if len(numbers) % (count + 1):
        raise ValueError(f"elements of type {options['TYPE']!r} have {count} nodes, {len(numbers)} numbers came")
    table = np.reshape(numbers, (-1, count + 1)).tolist()
    for number, *nodes in table:
        if number in deck.elements:
            raise ValueError(f"the element {number} comes twice, as in a file of several parts; write one flat mesh")
        deck.kinds[number], deck.elements[number] = kind, nodes
    if options.get("ELSET"):
        deck.members("ELSET", options["ELSET"], [str(row[0]) for row in table])


def _kind(name: str) -> tuple[str, int]:
    """meshio's kind of an element type, and how many nodes it has."""
    upper = name.upper()
    for dim, pattern in ((3, _SOLID), (1, _LINE), (2, _PLANE)):
        found = pattern.search(upper)
        if found and int(found[1]) in _KINDS[dim]:
            return _KINDS[dim][int(found[1])], int(found[1])
    if upper[:3] in _BEAMS:
        return _KINDS[1][_BEAMS[upper[:3]]], _BEAMS[upper[:3]]
    raise ValueError(f"elements of type {name!r} are not understood; remove them, or save solids, planes or lines")


def _read_set(deck: _Deck, card: str, options: dict[str, str], rows: list[list[str]]) -> None:
    name = options.get(card, "")
    words = [[word for word in row if word] for row in rows]
    if "GENERATE" in options:
        spans = [[int(word) for word in row] + [1] * (3 - len(row)) for row in words]
        words = [[str(n) for first, last, step in spans for n in range(first, last + 1, step)]]
    deck.members(card, name, [word for row in words for word in row])
    if card == "NSET" and options.get("ELSET"):
        elements = deck.sets.get(("ELSET", options["ELSET"].upper()), [])
        deck.members(card, name, [str(n) for e in elements for n in deck.elements.get(e, [])])


def _mesh(deck: _Deck) -> Mesh:
    """Nodes by their places, elements by kind, surfaces as cells of their own."""
    place = {number: k for k, number in enumerate(deck.nodes)}
    blocks: dict[str, list[int]] = {}
    for number, kind in deck.kinds.items():
        blocks.setdefault(kind, []).append(number)
    try:
        tables = [[[place[n] for n in deck.elements[e]] for e in own] for own in blocks.values()]
    except KeyError as error:
        raise ValueError(f"an element has the node {error}, which does not come") from None
    cells = [Block(kind, np.array(table)) for kind, table in zip(blocks, tables)]
    row = {e: (b, k) for b, own in enumerate(blocks.values()) for k, e in enumerate(own)}
    sets: dict[str, list[list[int]]] = {}
    points = {}
    for (kind, upper), members in deck.sets.items():
        name = deck.names[kind, upper]
        lost = [n for n in members if n not in (place if kind == "NSET" else row)]
        if lost:
            what = "node" if kind == "NSET" else "element"
            raise ValueError(f"the set {name!r} has {what} {lost[0]}, which does not come")
        if kind == "NSET":
            points[name] = np.array([place[n] for n in members], int)
            continue
        sets[name] = [[] for _ in cells]
        for e in members:
            sets[name][row[e][0]].append(row[e][1])
    for name, faces in deck.surfaces.items():
        for block in _faces(deck, place, faces):
            for lists in sets.values():
                lists.append([])
            sets.setdefault(name, [[] for _ in range(len(cells) + 1)])[-1].extend(range(len(block.data)))
            cells.append(block)
    return Mesh(
        np.array(list(deck.nodes.values())),
        cells,
        point_sets=points,
        cell_sets={name: [np.array(rows, int) for rows in lists] for name, lists in sets.items()},
    )


def _faces(deck: _Deck, place: dict[int, int], faces: list[tuple[str, str]]) -> list[Block]:
    """The faces of a surface, by corners: lines, triangles and quadrilaterals."""
    found: dict[str, list[list[int]]] = {}
    for who, label in faces:
        elements = [int(who)] if who.isdigit() else deck.sets.get(("ELSET", who.upper()), [])
        for e in elements:
            base = deck.kinds.get(e, "").rstrip("0123456789")
            match = re.fullmatch(r"[SE](\d)", label)
            if match is None or not 0 < int(match[1]) <= len(_FACES.get(base, [])):
                if label in ("SPOS", "SNEG", "") and dimension(base or "none") in (1, 2):
                    corners = deck.elements[e][: {"line": 2, "triangle": 3, "quad": 4}[base]]
                else:
                    raise ValueError(f"the surface has the face {label!r} of the element {who!r}, which it has not")
            else:
                corners = [deck.elements[e][int(c)] for c in _FACES[base][int(match[1]) - 1]]
            kind = {2: "line", 3: "triangle", 4: "quad"}[len(corners)]
            found.setdefault(kind, []).append([place[n] for n in corners])
    return [Block(kind, np.array(rows)) for kind, rows in found.items()]
