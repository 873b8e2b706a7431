"""What benchmarks take on their command lines: ``--help`` prints the module's docstring, unknown flags are refused."""

from __future__ import annotations

import argparse
import sys


def arguments(doc: str | None, *flags: str, names: str = "") -> argparse.Namespace:
    """The arguments of this process.

    flags: ``"quick"`` for a switch ``--quick``, ``"only="`` for a text ``--only=TEXT``; names: what the other
    arguments name, in a word; without it there are none.
    """
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    parser = argparse.ArgumentParser(
        prog=f"python -m {spec.name}" if spec else None, description=doc, allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    if names:
        parser.add_argument("names", nargs="*", metavar=names)
    for flag in flags:
        if flag.endswith("="):
            parser.add_argument(f"--{flag[:-1]}", default="")
        else:
            parser.add_argument(f"--{flag}", action="store_true")
    return parser.parse_args()
