"""Nothing assumes the first device or a CPU: the same code on a second device, and without the CPU's options."""

import os
import subprocess
import sys

import jax
import numpy as np

import jsmitsm as js

ENDS = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
PROBLEM = js.Problem(lambda u, x: js.laplacian(u)(x) + jax.numpy.exp(x[0]), ENDS)
CLOUD = js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2)

ON_THE_SECOND = """
import jax; jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np
import jsmitsm as js
from jsmitsm.discretization import sharing
from jsmitsm.particle import batches, devices
sharing.PIECE = 32  # in pieces, side by side
ends = dict.fromkeys(("left", "right", "bottom", "top"), js.dirichlet(0.0))
cloud = js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2)
problem = lambda c: js.Problem(lambda u, x: js.laplacian(u)(x) + c * jnp.exp(x[0]), ends)
near = js.stencils(cloud, size=14)
def mean(c):
    return jnp.mean(js.solve(problem(c), cloud, order=2, depth=0, stencils=near, solver="dense").u)
results = []
for device in jax.devices():
    with jax.default_device(device):
        value, slope = jax.jit(jax.value_and_grad(mean), compiler_options=batches.QUICKLY)(1.0)
        assert value.devices() == {device}, (value.devices(), device)
        results.append([*np.asarray(js.solve(problem(1.0), cloud, order=2, depth=0).u), value, slope])
assert len(results) == 2 and np.allclose(*results, rtol=1e-11)
# Both at once, an odd number of rows at that: each makes a part of them.
devices.WORTH, made, inner = 8, [], devices.side_by_side
def counted(function, *arguments):
    made.append((function.__name__, inner(function, *arguments)))
    return made[-1][1]
devices.side_by_side = counted
both = js.solve(problem(1.0), js.rectangle((0, 0), (1, 1), (13, 13), jitter=0.2), order=2, depth=0)
assert np.allclose(both.u, results[0][:-2], rtol=1e-11)
alone = js.solve(problem(1.0), cloud, order=2, depth=0)
assert np.allclose(both.coefficients, alone.coefficients, rtol=1e-8, atol=1e-8)
assert {"rows", "coefficients"} <= {name for name, _ in made}
assert all(len(x.devices()) == 2 for _, some in made for x in jax.tree.leaves(some))
print("the same on both")
"""


def test_the_second_of_two_devices():
    two = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    flags = os.environ | {"XLA_FLAGS": two, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([sys.executable, "-c", ON_THE_SECOND], capture_output=True, text=True, env=flags)
    assert "the same on both" in done.stdout, done.stderr[-2000:]


def test_without_the_options_of_the_cpu(monkeypatch):
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, *_, **__: compiled.append(name) if name.endswith("backend_compile_duration") else None
    )
    here = js.solve(PROBLEM, CLOUD, order=3)
    compiled.clear()
    again = js.solve(PROBLEM, CLOUD, order=3)
    assert not compiled
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    there = js.solve(PROBLEM, CLOUD, order=3)
    assert compiled, "a program of its own"
    for sol in (again, there):
        np.testing.assert_allclose(sol.u, here.u, rtol=1e-11, atol=1e-15)


def test_multigrid_on_another_device(monkeypatch):
    """The cycle and the iteration in JAX, forward and adjoint, against LU."""
    cloud = js.rectangle((0, 0), (1, 1), (31, 31), jitter=0.3)
    near = js.stencils(cloud, size=14)
    problem = lambda c: js.Problem(lambda u, x: js.laplacian(u)(x) + c * jax.numpy.exp(x[0]), ENDS)
    here = js.solve(problem(1.0), cloud, order=2, depth=0, stencils=near, solver="sparse")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    there = js.solve(problem(1.0), cloud, order=2, depth=0, stencils=near, solver="iterative")
    assert there.stats["linear"]["backend"] == "device amg" and not there.stats["linear"]["messages"]
    assert 5 < there.stats["linear"]["iterations"] < 40
    np.testing.assert_allclose(there.u, here.u, rtol=1e-11, atol=1e-15)

    def mean(c):
        return jax.numpy.mean(js.solve(problem(c), cloud, order=2, depth=0, stencils=near, solver="iterative").u)

    value, slope = jax.value_and_grad(mean)(2.0)
    np.testing.assert_allclose(slope, value / 2.0, rtol=1e-10)  # linear in c
