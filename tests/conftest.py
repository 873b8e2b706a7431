import gc
import os
from importlib.metadata import version
from pathlib import Path

# Most programs of the tests run once, eager derivatives above all: XLA's older emitters compile them in half the time.
# XLA takes the flag before JAX is imported and aborts where it does not know it, so only where it was seen to exist.
# With the least effort as well, slopes of a maximum are zero now and then: what is computed twice differs by rounding.
if version("jaxlib").startswith("0.10."):
    os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_use_fusion_emitters=false"

# Threads of a library's dense algebra wait for each other by turning, a second for each eigenvalue problem of some
# hundred unknowns where other tests run beside.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np
import pytest

from jsmitsm.particle import batches

jax.config.update("jax_enable_x64", True)

# What a test compiles it runs once or twice: the local phase is compiled as for a few particles, and not as one kernel,
# which test_onekernel.py has. Processes of their own, as scripts of users, have the usual effort.
USUAL = {"EFFORT": batches.EFFORT, "SMALL": batches.SMALL}
batches.EFFORT, batches.SMALL = ((np.inf, batches.QUICKLY),), 0


@pytest.fixture
def usual_effort(monkeypatch):
    """The compiler's effort that users get."""
    for name, value in USUAL.items():
        monkeypatch.setattr(batches, name, value)


# Tracing makes objects by the million that nothing else holds: a collection every 700 of them is a twelfth of the time.
gc.set_threshold(20_000, 20, 20)

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
