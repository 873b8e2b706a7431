"""Ctrl-C: a long solve and a long tune end at once, the user's program sees it, and the next solve is right."""

import subprocess
import sys

PROMPT = 3.0  # seconds, some ten times what it takes

CHILD = """
import os, signal, sys, threading, time
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp
import numpy as np
import jsmitsm as js
from jsmitsm.linear import linsolve
from jsmitsm.runtime.interrupts import interruptible

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored from the start in a background job of a shell
SIDES = ("left", "right", "bottom", "top")
exact = lambda x: jnp.exp(x[0]) * jnp.sin(x[1])
problem = js.Problem(lambda u, x: js.laplacian(u)(x), {s: js.dirichlet(exact) for s in SIDES})
small, large = (js.rectangle((0, 0), (1, 1), (n, n), jitter=0.2) for n in (11, 250))


def right():
    sol = js.solve(problem, small)
    assert np.abs(sol.u - jax.vmap(exact)(small.points)).max() < 1e-5


def interrupted(call, after):
    sent = []
    def press():
        sent.append(time.perf_counter())
        os.kill(os.getpid(), signal.SIGINT)
    # Python itself loses an interrupt that falls into the callback of a weak reference or of a garbage collection, of
    # which JAX has many.
    for attempt in range(8):
        linsolve.clear_cache()
        threading.Timer(after, press).start()
        try:
            call()
        except KeyboardInterrupt:
            return time.perf_counter() - sent[-1]
    raise AssertionError("it ended before it was interrupted")


# Compiled before: that takes longer than all else.
solved = lambda: js.solve(problem, large, order=2, depth=0)
tuned = lambda n: js.tune(problem, small, js.SuperGaussian(h=0.1, d=3.5), method="SSPH", order=2, steps=n)
solved(), tuned(2), right()
for after in (0.02, 0.05, 0.1, 0.2):  # in the search, the local fits, the assembly
    print("solve", interrupted(solved, after))
    right()
# Stands for a factorisation, during which Python does not look at signals.
print("factorisation", interrupted(lambda: interruptible(lambda: time.sleep(20)), 0.3))
print("tune", interrupted(lambda: tuned(10**5), 0.2))
right()
sys.stdout.flush()
os._exit(0)  # jaxlib 0.10.2, once interrupted in a compilation, may crash when the interpreter ends
"""


def test_ctrl_c_ends_a_solve_and_a_tune_at_once():
    child = [sys.executable, "-c", CHILD]
    done = subprocess.run(child, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    waits = [line.split() for line in done.stdout.splitlines()]
    assert [what for what, _ in waits] == ["solve"] * 4 + ["factorisation", "tune"]
    assert max(float(seconds) for _, seconds in waits) < PROMPT, waits
