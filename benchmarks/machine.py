"""What a measurement ran on: processor, cores and versions, and nothing that names a user or a place."""

from __future__ import annotations

import gc
import os
import platform
from pathlib import Path


def processor() -> str:
    """The processor's model name."""
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def describe() -> dict[str, str | int]:
    """The machine and the versions, for the head of a data file."""
    import jax
    import numpy
    import scipy

    return {
        "processor": processor(),
        "cores": cores(),
        "system": platform.system(),
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
    }


def tidy() -> None:
    """Compiled programs hold memory maps, of which a process has a limited number."""
    import jax

    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 30000:
        jax.clear_caches()
        gc.collect()
