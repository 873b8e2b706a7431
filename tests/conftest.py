import gc
import os
from importlib.metadata import version
from pathlib import Path

# Most programs of the tests run once, eager derivatives above all: XLA's older emitters compile them in half the time.
# XLA takes the flag before JAX is imported and aborts where it does not know it, so only where it was seen to exist.
if version("jaxlib").startswith("0.10."):
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"

# Threads of a library's dense algebra wait for each other by turning, a second for each eigenvalue problem of some
# hundred unknowns where other tests run beside.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np
import pytest

from jsmitsm.particle import batches
from jsmitsm.runtime import whole_program

jax.config.update("jax_enable_x64", True)

# What a test compiles it runs once or twice: most of its time would go into making programs fast. The local phase is
# compiled with the least effort for every size, as for a few particles, and not as one kernel (test_onekernel.py has
# those). Notebooks, the user's scripts and the README's commands are processes of their own, with the usual effort.
EFFORT = batches._EFFORT, batches._SMALL
batches._EFFORT, batches._SMALL = ((np.inf, batches.QUICKLY),), 0
whole_program._LITTLE["xla_backend_optimization_level"] = 0


@pytest.fixture
def usual_effort(monkeypatch):
    """The effort of the compiler that users get."""
    monkeypatch.setattr(batches, "_EFFORT", EFFORT[0])
    monkeypatch.setattr(batches, "_SMALL", EFFORT[1])


# Compiled programs hold memory maps, of which Linux gives a process 65530: a whole suite would run out of them.
MAPS = 25_000


@pytest.fixture(autouse=True, scope="module")
def drop_compiled_programs():
    """Programs serve the next file too, until there are too many of them."""
    yield
    maps = Path("/proc/self/maps")
    if not maps.exists() or maps.read_bytes().count(b"\n") > MAPS:
        jax.clear_caches()
        gc.collect()
