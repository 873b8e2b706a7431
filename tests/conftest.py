import gc

import jax
import pytest

jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True, scope="module")
def drop_compiled_programs():
    """Compiled programs hold memory maps, of which Linux gives a process 65530: a whole suite would run out of them."""
    yield
    jax.clear_caches()
    gc.collect()
