"""No solve hangs, on one core or two: 100 each, dense and sparse, plain, under jit and in pieces on all cores.

Batched LAPACK calls and callbacks are known to wait for one another on machines with few cores.
Every child is given its cores before JAX starts, and a time limit.
"""

import os
import subprocess
import sys

import pytest

SOLVES = 100
LIMIT = 120.0  # seconds; a child takes 10 to 20 on an idle machine

CHILD = """
import os, sys
os.sched_setaffinity(0, {cores})
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import jsmitsm as js
from jsmitsm.particle.batches import QUICKLY

SIDES = ("left", "right", "bottom", "top")


def pde(u, x, q):
    return js.laplacian(u)(x) + q * jnp.sin(x[0]) * u(x) - 1.0


def ready(n):
    cloud = js.rectangle((0, 0), (1, 1), (n, n), jitter=0.2)
    return js.Problem(pde, {{s: js.dirichlet(0.0) for s in SIDES}}, params=0.0), cloud, js.stencils(cloud, size=14)


small, large = ready(8), ready(17)  # 36 and 225 unknowns: LAPACK and the sparse solver
huge = ready(95)  # more than a piece: the cores share its local fits
largest = lambda q, task: js.solve(task[0].replace(params=q), task[1], order=2, depth=0, stencils=task[2]).u.max()
jitted = [jax.jit(lambda q, task=task: largest(q, task), compiler_options=QUICKLY) for task in (small, large)]
done = k = 0
while done < {solves}:
    q, k = 0.05 * k, k + 1
    plain = [float(largest(q, task)) for task in (small, large)]
    compiled = [float(f(q)) for f in jitted]
    assert np.allclose(plain, compiled, rtol=1e-10), (plain, compiled)
    done += 4
    if k % 5 == 0:
        largest(q, huge)
        done += 1
    print(done, flush=True)
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="the system cannot bind a process to cores")
@pytest.mark.parametrize("count", [1, 2])
def test_a_hundred_solves_end(count):
    cores = sorted(os.sched_getaffinity(0))[:count]
    if len(cores) < count:
        pytest.skip(f"this process has {len(cores)} core(s)")
    as_users_have_it = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    child = [sys.executable, "-c", CHILD.format(cores=set(cores), solves=SOLVES)]
    try:
        done = subprocess.run(child, capture_output=True, text=True, timeout=LIMIT, env=as_users_have_it)
    except subprocess.TimeoutExpired as late:
        told = (late.stdout or b"").decode().split()
        pytest.fail(f"hung on {count} core(s) after {told[-1] if told else 0} of {SOLVES} solves")
    assert done.returncode == 0, done.stderr[-2000:]
    assert int(done.stdout.split()[-1]) >= SOLVES
