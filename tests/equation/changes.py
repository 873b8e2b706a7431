"""Ways in which Python can change what a function sees.

Each is a function of a `pytest.MonkeyPatch` and a directory that returns ``(read, change)``: ``read()`` gives 1.0, and
2.0 once ``change()`` was called; what it reads, and how, is the way's name. What lasts is undone by the patch.
"""

import abc
import array
import builtins
import collections
import contextvars
import ctypes
import dataclasses
import enum
import functools
import importlib
import itertools
import math
import operator
import os
import sys
import threading
import types
import weakref

import jax
import jax.numpy as jnp
import numpy as np
import scipy.interpolate

import jsmitsm as js

WAYS = {}


def way(function):
    WAYS[function.__name__] = function
    return function


K = 1.0  # read by name below, changed by the patch
BOX = types.SimpleNamespace(k=1.0)


def body_of_a_loop(i, total):
    return total + K / 4


def _global(patch):
    return lambda: patch.setitem(globals(), "K", 2.0)


class Box:
    """Any object of the user's."""

    def __init__(self, k=1.0):
        self.k = k

    def get(self):
        return self.k


def module(patch, **content):
    """A settings module of the user's, known to the import system."""
    made = types.ModuleType("settings_of_a_user")
    vars(made).update(content)
    patch.setitem(sys.modules, made.__name__, made)
    return made


# ------------------------------------------------------------------ names, closures, containers


@way
def a_global(patch, path):
    return lambda: K, _global(patch)


@way
def a_global_of_a_helper(patch, path):
    def helper():
        return K

    return lambda: helper() * 1.0, _global(patch)


@way
def a_global_that_hides_a_builtin(patch, path):
    return lambda: pow(1.0, 1.0), lambda: patch.setitem(globals(), "pow", lambda x, y: 2.0)


@way
def a_closure(patch, path):
    k = 1.0

    def change():
        nonlocal k
        k = 2.0

    return lambda: k, change


@way
def the_contents_of_a_cell(patch, path):
    k = 1.0
    read = lambda: k
    return read, lambda: setattr(read.__closure__[0], "cell_contents", 2.0)


@way
def a_list(patch, path):
    k = [1.0]
    return lambda: k[0], lambda: k.__setitem__(0, 2.0)


@way
def a_dict(patch, path):
    k = {"k": 1.0}
    return lambda: k["k"], lambda: k.update(k=2.0)


@way
def nested_containers(patch, path):
    k = {"a": [(1, {"k": [1.0]})]}
    return lambda: k["a"][0][1]["k"][0], lambda: k["a"][0][1]["k"].__setitem__(0, 2.0)


@way
def a_set(patch, path):
    k = {1}
    return lambda: 2.0 if 2 in k else 1.0, lambda: k.add(2)


@way
def the_order_of_a_dict(patch, path):
    k = {"a": 1.0, "b": 2.0}
    return lambda: next(iter(k.values())), lambda: k.update(a=k.pop("a"))


@way
def defaults(patch, path):
    def read(k=1.0):
        return k

    return read, lambda: setattr(read, "__defaults__", (2.0,))


@way
def keyword_defaults(patch, path):
    def read(*, k=1.0):
        return k

    return read, lambda: setattr(read, "__kwdefaults__", {"k": 2.0})


@way
def the_code_of_a_helper(patch, path):
    def helper():
        return 1.0

    def other():
        return 2.0

    return lambda: helper(), lambda: setattr(helper, "__code__", other.__code__)


@way
def the_keywords_of_a_partial(patch, path):
    k = functools.partial(lambda k: k, k=1.0)
    return k, lambda: k.keywords.update(k=2.0)


@way
def an_attribute_of_a_partial(patch, path):
    k = functools.partial(float, 1.0)
    k.k = 1.0
    return lambda: k.k, lambda: setattr(k, "k", 2.0)


@way
def globals_by_name(patch, path):
    return lambda: globals()["K"], _global(patch)


@way
def evaluated_text(patch, path):
    return lambda: eval("K"), _global(patch)


@way
def executed_text(patch, path):
    def read():
        found = {}
        exec("k = K", globals(), found)
        return found["k"]

    return read, _global(patch)


@way
def globals_of_its_own(patch, path):
    scope = {"k": 1.0}
    read = types.FunctionType(compile("k", "", "eval"), scope)
    return read, lambda: scope.update(k=2.0)


@way
def builtins_of_its_own(patch, path):
    scope = {"__builtins__": {"k": 1.0}}
    exec("def read(): return k", scope)
    return scope["read"], lambda: scope["__builtins__"].update(k=2.0)


@way
def a_builtin_replaced(patch, path):
    return lambda: pow(1.0, 1.0), lambda: patch.setattr(builtins, "pow", lambda x, y: 2.0)


@way
def a_frame(patch, path):
    return lambda: sys._getframe().f_globals["K"], _global(patch)


@way
def the_frame_of_a_generator(patch, path):
    return lambda: (i for i in ()).gi_frame.f_globals["K"], _global(patch)


@way
def globals_of_a_function(patch, path):
    return lambda: body_of_a_loop.__globals__["K"], _global(patch)


# ------------------------------------------------------------------ modules


@way
def a_module(patch, path):
    cfg = module(patch, k=1.0)
    return lambda: cfg.k, lambda: setattr(cfg, "k", 2.0)


@way
def a_module_within_a_module(patch, path):
    cfg = module(patch, inner=module(patch, k=1.0))
    return lambda: cfg.inner.k, lambda: setattr(cfg.inner, "k", 2.0)


@way
def a_module_by_another_name(patch, path):
    cfg = module(patch, k=1.0)

    def read():
        other = cfg
        return other.k

    return read, lambda: setattr(cfg, "k", 2.0)


@way
def a_module_in_a_container(patch, path):
    cfg = [module(patch, k=1.0)]
    return lambda: cfg[0].k, lambda: setattr(cfg[0], "k", 2.0)


@way
def a_module_as_a_default(patch, path):
    cfg = module(patch, k=1.0)
    return lambda m=cfg: m.k, lambda: setattr(cfg, "k", 2.0)


@way
def a_module_given_to_a_helper(patch, path):
    cfg = module(patch, k=1.0)
    helper = lambda m: m.k
    return lambda: helper(cfg), lambda: setattr(cfg, "k", 2.0)


@way
def a_module_chosen_at_run_time(patch, path):
    cfg, other = module(patch, k=1.0), module(patch, k=3.0)
    return lambda: (cfg if K else other).k, lambda: setattr(cfg, "k", 2.0)


@way
def a_function_of_a_module(patch, path):
    cfg = module(patch, f=lambda: 1.0)
    return lambda: cfg.f(), lambda: setattr(cfg, "f", lambda: 2.0)


@way
def a_dict_in_a_module(patch, path):
    cfg = module(patch, table={"k": 1.0})
    return lambda: cfg.table["k"], lambda: cfg.table.update(k=2.0)


@way
def a_module_read_in_a_nested_function(patch, path):
    cfg = module(patch, k=1.0)
    return lambda: sum(cfg.k for _ in range(1)), lambda: setattr(cfg, "k", 2.0)


@way
def a_module_with_attributes_made_up(patch, path):
    k = [1.0]
    cfg = module(patch, __getattr__=lambda name: k[0])
    return lambda: cfg.k, lambda: k.__setitem__(0, 2.0)


@way
def a_module_of_another_class(patch, path):
    k = [1.0]
    cfg = module(patch)
    cfg.__class__ = type("Lazy", (types.ModuleType,), {"k": property(lambda self: k[0])})
    return lambda: cfg.k, lambda: k.__setitem__(0, 2.0)


@way
def the_dict_of_a_module(patch, path):
    cfg = module(patch, k=1.0)
    return lambda: vars(cfg)["k"], lambda: setattr(cfg, "k", 2.0)


@way
def an_import_inside(patch, path):
    cfg = module(patch, k=1.0)

    def read():
        import settings_of_a_user

        return settings_of_a_user.k

    return read, lambda: setattr(cfg, "k", 2.0)


@way
def a_name_imported_inside(patch, path):
    cfg = module(patch, k=1.0)

    def read():
        from settings_of_a_user import k

        return k

    return read, lambda: setattr(cfg, "k", 2.0)


@way
def a_module_loaded_again(patch, path):
    file = path / "loaded_again.py"
    file.write_text("def k(): return 1.0")
    patch.syspath_prepend(str(path))
    patch.setattr(sys, "dont_write_bytecode", True)
    patch.setitem(sys.modules, "loaded_again", None)  # what is imported below is forgotten with the patch
    del sys.modules["loaded_again"]
    cfg = importlib.import_module("loaded_again")

    def change():
        file.write_text("def k(): return 1.0 + 1.0")
        importlib.invalidate_caches()
        importlib.reload(cfg)

    return lambda: cfg.k(), change


@way
def the_table_of_modules(patch, path):
    module(patch, k=1.0)
    return lambda: sys.modules["settings_of_a_user"].k, lambda: module(patch, k=2.0)


# ------------------------------------------------------------------ attributes and objects


@way
def an_attribute_of_a_function(patch, path):
    def helper():
        pass

    helper.k = 1.0
    return lambda: helper.k, lambda: setattr(helper, "k", 2.0)


@way
def an_attribute_of_the_function_itself(patch, path):
    def read():
        return read.k

    read.k = 1.0
    return read, lambda: setattr(read, "k", 2.0)


@way
def an_attribute_by_name(patch, path):
    box = Box()
    return lambda: getattr(box, "k"), lambda: setattr(box, "k", 2.0)  # noqa: B009


@way
def an_attribute_by_a_getter(patch, path):
    box, get = Box(), operator.attrgetter("k")
    return lambda: get(box), lambda: setattr(box, "k", 2.0)


@way
def an_attribute_in_a_text(patch, path):
    box = BOX
    return lambda: float("{0.k}".format(box)), lambda: patch.setattr(box, "k", 2.0)  # noqa: UP030, UP032


@way
def an_attribute_of_a_module_in_a_text(patch, path):
    cfg = [module(patch, k=1.0)]
    return lambda: float("{0[0].k}".format(cfg)), lambda: setattr(cfg[0], "k", 2.0)  # noqa: UP030, UP032


@way
def an_attribute_of_an_object(patch, path):
    box = Box()
    return lambda: box.k, lambda: setattr(box, "k", 2.0)


@way
def a_namespace(patch, path):
    return lambda: BOX.k, lambda: patch.setattr(BOX, "k", 2.0)


@way
def an_attribute_of_a_class(patch, path):
    A = type("A", (), {"k": 1.0})
    return lambda: A.k, lambda: setattr(A, "k", 2.0)


@way
def an_inherited_attribute(patch, path):
    A = type("A", (), {"k": 1.0})
    b = type("B", (A,), {})()
    return lambda: b.k, lambda: setattr(A, "k", 2.0)


@way
def an_attribute_of_a_metaclass(patch, path):
    M = type("M", (type,), {"k": 1.0})
    A = M("A", (), {})
    return lambda: A.k, lambda: setattr(M, "k", 2.0)


@way
def the_class_of_an_object(patch, path):
    A, B = type("A", (), {"k": 1.0}), type("B", (), {"k": 2.0})
    a = A()
    return lambda: a.k, lambda: setattr(a, "__class__", B)


@way
def a_dataclass(patch, path):
    box = dataclasses.make_dataclass("Data", [("k", float)])(1.0)
    return lambda: box.k, lambda: setattr(box, "k", 2.0)


@way
def a_property(patch, path):
    hidden = {"k": 1.0}
    box = type("A", (), {"k": property(lambda self: hidden["k"])})()
    return lambda: box.k, lambda: hidden.update(k=2.0)


@way
def a_cached_property_forgotten(patch, path):
    hidden = [1.0]
    A = type("A", (), {"k": (p := functools.cached_property(lambda self: hidden[0]))})
    p.__set_name__(A, "k")
    box = A()

    def change():
        hidden[0] = 2.0
        del box.__dict__["k"]

    return lambda: box.k, change


@way
def a_descriptor(patch, path):
    class D:
        k = 1.0

        def __get__(self, instance, owner):
            return D.k

    box = type("A", (), {"k": D()})()
    return lambda: box.k, lambda: setattr(D, "k", 2.0)


@way
def slots(patch, path):
    box = type("A", (), {"__slots__": ("k",)})()
    box.k = 1.0
    return lambda: box.k, lambda: setattr(box, "k", 2.0)


@way
def attributes_made_up(patch, path):
    k = [1.0]
    box = type("A", (), {"__getattr__": lambda self, name: k[0]})()
    return lambda: box.k, lambda: k.__setitem__(0, 2.0)


@way
def a_method_replaced(patch, path):
    A = type("A", (), {"k": lambda self: 1.0})
    a = A()
    return lambda: a.k(), lambda: setattr(A, "k", lambda self: 2.0)


@way
def a_method_of_one_object_replaced(patch, path):
    a = Box()
    return lambda: a.get(), lambda: setattr(a, "get", lambda: 2.0)


@way
def a_static_method_replaced(patch, path):
    A = type("A", (), {"k": staticmethod(lambda: 1.0)})
    return lambda: A.k(), lambda: setattr(A, "k", staticmethod(lambda: 2.0))


@way
def a_bound_method(patch, path):
    box = Box()
    return box.get, lambda: setattr(box, "k", 2.0)


@way
def a_callable_object(patch, path):
    box = type("A", (Box,), {"__call__": Box.get})()
    return box, lambda: setattr(box, "k", 2.0)


@way
def an_operator_of_an_object(patch, path):
    A = type("A", (), {"__mul__": lambda self, x: 1.0})
    a = A()
    return lambda: a * 1.0, lambda: setattr(A, "__mul__", lambda self, x: 2.0)


@way
def a_class_made_by_exec(patch, path):
    scope = {}
    exec("k = 1.0\nclass A:\n    def __call__(self): return k\n", scope)
    a = scope["A"]()
    return lambda: a(), lambda: scope.update(k=2.0)


@way
def a_class_made_inside(patch, path):
    cfg = module(patch, k=1.0)

    def read():
        class A:
            k = cfg.k

        return A.k

    return read, lambda: setattr(cfg, "k", 2.0)


@way
def an_abstract_class_joined(patch, path):
    A = abc.ABCMeta("A", (), {})
    return lambda: 2.0 if isinstance(1.0, A) else 1.0, lambda: A.register(float)


@way
def a_named_tuple(patch, path):
    T = collections.namedtuple("T", "a b")
    t = T(1.0, 2.0)
    return lambda: t.a, lambda: setattr(T, "a", T.b)


@way
def an_enumeration(patch, path):
    E = enum.Enum("E", {"a": 1.0})
    return lambda: E.a.value, lambda: setattr(E.a, "_value_", 2.0)


@way
def a_number_with_attributes(patch, path):
    k = type("F", (float,), {})(1.0)
    k.k = 1.0
    return lambda: k.k, lambda: setattr(k, "k", 2.0)


@way
def a_generic_function(patch, path):
    generic = functools.singledispatch(lambda x: 1.0)
    return lambda: generic(1.0), lambda: generic.register(float, lambda x: 2.0)


@way
def a_cached_function_cleared(patch, path):
    k = [1.0]
    cached = functools.lru_cache(lambda: k[0])

    def change():
        k[0] = 2.0
        cached.cache_clear()

    return lambda: cached(), change


# ------------------------------------------------------------------ builtins bound to objects, collections, iterators


@way
def a_bound_builtin_of_a_dict(patch, path):
    k = {"k": 1.0}
    get = k.get
    return lambda: get("k"), lambda: k.update(k=2.0)


@way
def a_bound_builtin_of_a_list(patch, path):
    k = [1.0]
    get = k.__getitem__
    return lambda: get(0), lambda: k.__setitem__(0, 2.0)


@way
def a_bound_builtin_of_an_array(patch, path):
    k = np.ones(1)
    item = k.item
    return lambda: item(), lambda: k.fill(2.0)


@way
def an_iterator(patch, path):
    k = [1.0]
    ever = itertools.chain.from_iterable(k for _ in itertools.count())
    return lambda: next(ever), lambda: k.__setitem__(0, 2.0)


@way
def a_generator(patch, path):
    k = [1.0]

    def generate():
        while True:
            yield k[0]

    ever = generate()
    return lambda: next(ever), lambda: k.__setitem__(0, 2.0)


@way
def a_deque(patch, path):
    k = collections.deque([1.0])
    return lambda: k[0], lambda: k.appendleft(2.0)


@way
def a_dict_with_a_factory(patch, path):
    k = collections.defaultdict(lambda: 1.0)
    return lambda: k["k"], lambda: k.update(k=2.0)


@way
def a_chain_of_dicts(patch, path):
    first = {"k": 1.0}
    k = collections.ChainMap(first)
    return lambda: k["k"], lambda: first.update(k=2.0)


@way
def a_view_of_a_dict(patch, path):
    k = {"k": 1.0}
    values = k.values()
    return lambda: next(iter(values)), lambda: k.update(k=2.0)


@way
def bytes_that_change(patch, path):
    k = bytearray([1])
    return lambda: float(k[0]), lambda: k.__setitem__(0, 2)


@way
def a_view_of_memory(patch, path):
    owner = bytearray([1])
    k = memoryview(owner)
    return lambda: float(k[0]), lambda: owner.__setitem__(0, 2)


@way
def an_array_of_the_standard_library(patch, path):
    k = array.array("d", [1.0])
    return lambda: k[0], lambda: k.__setitem__(0, 2.0)


@way
def memory_of_c(patch, path):
    k = ctypes.c_double(1.0)
    return lambda: k.value, lambda: setattr(k, "value", 2.0)


@way
def a_weak_reference(patch, path):
    box = Box()
    ref = weakref.ref(box)
    return lambda: ref().k, lambda: setattr(box, "k", 2.0)


@way
def a_weak_dictionary(patch, path):
    box = Box()
    known = weakref.WeakValueDictionary(box=box)
    return lambda: known["box"].k, lambda: setattr(box, "k", 2.0)


@way
def a_context_variable(patch, path):
    k = contextvars.ContextVar("k", default=1.0)
    return lambda: k.get(), lambda: k.set(2.0)


@way
def what_a_thread_keeps(patch, path):
    k = threading.local()
    k.k = 1.0
    return lambda: k.k, lambda: setattr(k, "k", 2.0)


@way
def the_environment(patch, path):
    patch.setenv("K_OF_A_TEST", "1")
    return lambda: float(os.environ["K_OF_A_TEST"]), lambda: patch.setenv("K_OF_A_TEST", "2")


@way
def the_environment_by_a_function(patch, path):
    patch.setenv("K_OF_A_TEST", "1")
    return lambda: float(os.getenv("K_OF_A_TEST")), lambda: patch.setenv("K_OF_A_TEST", "2")


@way
def a_file(patch, path):
    file = str(path / "k.txt")
    write = lambda text: open(file, "w").write(text) and None
    write("1.0")

    def read():
        with open(file) as f:
            return float(f.read())

    return read, lambda: write("2.0")


@way
def a_file_by_numpy(patch, path):
    file = str(path / "k.npy")
    np.save(file, 1.0)
    return lambda: float(np.load(file)), lambda: np.save(file, 2.0)


@way
def the_arguments_of_the_program(patch, path):
    patch.setattr(sys, "argv", ["", "1.0"])
    return lambda: float(sys.argv[1]), lambda: patch.setattr(sys, "argv", ["", "2.0"])


# ------------------------------------------------------------------ numpy, scipy


@way
def an_array(patch, path):
    k = np.ones(3)
    return lambda: k[1], lambda: k.__setitem__(1, 2.0)


@way
def an_array_that_is_recorded(patch, path):
    k = np.ones(3)
    return lambda: jnp.interp(0.5, np.arange(3.0), k), lambda: k.fill(2.0)


@way
def a_view_of_an_array(patch, path):
    owner = np.ones(3)
    k = owner[1:]
    return lambda: k[0], lambda: owner.fill(2.0)


@way
def the_array_behind_a_view(patch, path):
    owner = np.ones(3)
    k = owner[1:]
    return lambda: k.base[0], lambda: owner.__setitem__(0, 2.0)


@way
def an_array_without_axes(patch, path):
    k = np.array(1.0)
    return lambda: jnp.asarray(k), lambda: k.fill(2.0)


@way
def an_array_of_objects(patch, path):
    k = np.array([Box()])
    return lambda: k[0].k, lambda: setattr(k[0], "k", 2.0)


@way
def a_structured_array(patch, path):
    k = np.array([(1.0, 2.0)], [("a", float), ("b", float)])
    return lambda: k["a"][0], lambda: setattr(k.dtype, "names", ("b", "a"))


@way
def an_attribute_of_an_array(patch, path):
    k = np.ones(1).view(type("A", (np.ndarray,), {}))
    k.k = 1.0
    return lambda: k.k, lambda: setattr(k, "k", 2.0)


@way
def the_flags_of_an_array(patch, path):
    k = np.ones(1)
    return lambda: 1.0 if k.flags.writeable else 2.0, lambda: k.setflags(write=False)


@way
def one_array_by_two_names(patch, path):
    k = np.ones(2)
    names = [k, k]
    return lambda: 1.0 if names[1] is names[0] else 2.0, lambda: names.__setitem__(1, k.copy())


@way
def how_numpy_prints(patch, path):
    k = np.array([1.26])
    options = np.get_printoptions()
    patch.setattr(patch, "undo", lambda undo=patch.undo: (np.set_printoptions(**options), undo()))
    return lambda: 1.0 if f"{k}" == "[1.26]" else 2.0, lambda: np.set_printoptions(precision=1)


@way
def what_numpy_raises(patch, path):
    k, rules = np.zeros(1), np.seterr(divide="ignore")
    patch.setattr(patch, "undo", lambda undo=patch.undo: (np.seterr(**rules), undo()))

    def read():
        try:
            1.0 / k
        except FloatingPointError:
            return 2.0
        return 1.0

    return read, lambda: np.seterr(divide="raise")


@way
def a_masked_array(patch, path):
    k = np.ma.array([1.0, 2.0], mask=[False, True])
    return lambda: float(k.max()), lambda: setattr(k, "mask", False)


@way
def a_polynomial(patch, path):
    p = np.poly1d([1.0])
    return lambda: p(0.0), lambda: p.coeffs.fill(2.0)


@way
def a_polynomial_of_the_new_kind(patch, path):
    p = np.polynomial.Polynomial([1.0])
    return lambda: p(0.0), lambda: setattr(p, "coef", np.array([2.0]))


@way
def a_function_made_vector(patch, path):
    f = np.vectorize(lambda x: K)
    return lambda: float(f(0.0)), _global(patch)


@way
def a_ufunc_from_python(patch, path):
    f = np.frompyfunc(lambda x: K, 1, 1)
    return lambda: float(f(0.0)), _global(patch)


@way
def an_interpolator(patch, path):
    f = scipy.interpolate.RegularGridInterpolator((np.array([0.0, 1.0]),), np.ones(2))
    return lambda: float(f([[0.5]])[0]), lambda: f.values.fill(2.0)


@way
def a_spline(patch, path):
    f = scipy.interpolate.CubicSpline(np.arange(4.0), np.ones(4))
    return lambda: float(f(0.5)), lambda: f.c.__imul__(2.0)


@way
def a_function_of_numpy_replaced(patch, path):
    return lambda: np.nanmean(np.ones(1)), lambda: patch.setattr(np, "nanmean", lambda x: 2.0)


@way
def a_function_of_the_standard_library_replaced(patch, path):
    return lambda: math.cos(0.0), lambda: patch.setattr(math, "cos", lambda x: 2.0)


# ------------------------------------------------------------------ jax and this package


@way
def an_array_of_jax_that_shares_memory(patch, path):
    owner = np.ones(4096)
    k = jax.device_put(owner)
    shared = np.shares_memory(np.asarray(k), owner)
    hold = [k]
    return lambda: hold[0][7], lambda: owner.fill(2.0) if shared else hold.__setitem__(0, jnp.full(4096, 2.0))


@way
def a_jitted_helper(patch, path):
    helper = jax.jit(lambda: jnp.asarray(K))
    return lambda: helper(), _global(patch)


@way
def the_body_of_a_loop_in_jax(patch, path):
    return lambda: jax.lax.fori_loop(0, 4, body_of_a_loop, 0.0), _global(patch)


@way
def a_branch_in_jax(patch, path):
    yes, no = lambda: jnp.asarray(K), lambda: jnp.asarray(3.0)
    return lambda: jax.lax.cond(True, yes, no), _global(patch)


@way
def a_loop_over_rows_in_jax(patch, path):
    return lambda: jax.lax.map(lambda x: x * K, jnp.ones(1))[0], _global(patch)


def times_k(x):
    return x * K


@way
def a_piece_of_a_function_in_jax(patch, path):
    return lambda: jnp.piecewise(jnp.ones(1), [jnp.ones(1) > 0], [times_k, 0.0])[0], _global(patch)


@way
def a_function_recomputed_by_jax(patch, path):
    again = jax.checkpoint(times_k)
    return lambda: again(1.0), _global(patch)


@way
def a_ufunc_of_jax(patch, path):
    again = jnp.frompyfunc(lambda x, y: x + y * K, 2, 1)
    return lambda: again.reduce(jnp.array([0.0, 1.0])), _global(patch)


@way
def a_function_with_a_rule(patch, path):
    f = jax.custom_jvp(lambda x: K * x)
    f.defjvp(lambda x, dx: (K * x[0], K * dx[0]))
    return lambda: f(1.0), _global(patch)


@way
def a_derivative_by_jax(patch, path):
    slope = jax.grad(lambda x: K * x)
    return lambda: slope(1.0), _global(patch)


@way
def a_mapped_function(patch, path):
    every = jax.vmap(lambda x: K * x)
    return lambda: every(jnp.ones(1))[0], _global(patch)


@way
def an_interpolator_of_jax(patch, path):
    f = jax.scipy.interpolate.RegularGridInterpolator((jnp.array([0.0, 1.0]),), jnp.ones(2))
    return lambda: f(jnp.array([[0.5]]))[0], lambda: setattr(f, "values", jnp.full(2, 2.0))


@way
def a_partial_of_jax(patch, path):
    k = [1.0]
    f = jax.tree_util.Partial(lambda: k[0])
    return lambda: f(), lambda: k.__setitem__(0, 2.0)


@way
def a_function_called_back(patch, path):
    k = [1.0]
    call = lambda: np.asarray(k[0])
    shape = jax.ShapeDtypeStruct((), float)
    return lambda: jax.lax.stop_gradient(jax.pure_callback(call, shape)), lambda: k.__setitem__(0, 2.0)


@way
def a_function_of_jax_replaced(patch, path):
    @functools.wraps(jnp.cos)
    def other(x):
        return 2.0

    return lambda: jnp.cos(0.0), lambda: patch.setattr(jnp, "cos", other)


def _own_function_in_place(patch, make):
    """A function of the user's, by the name of one of the library's, in a coat of the library's making."""

    def square(x, y=None):
        return K * x

    patch.setattr(jnp, "square", make(square))
    return _global(patch)


@way
def a_function_of_jax_replaced_by_a_mapped_one(patch, path):
    change = _own_function_in_place(patch, jax.vmap)
    return lambda: jnp.square(jnp.ones(1))[0], change


@way
def a_function_of_jax_replaced_by_a_ufunc(patch, path):
    change = _own_function_in_place(patch, lambda square: jnp.frompyfunc(square, 2, 1))
    return lambda: jnp.square(1.0, 1.0), change


@way
def an_attribute_of_a_function_of_jax(patch, path):
    patch.setattr(jnp.where, "k", 1.0, raising=False)
    return lambda: jnp.where.k, lambda: patch.setattr(jnp.where, "k", 2.0)


@way
def an_attribute_of_a_type_of_jax(patch, path):
    patch.setattr(jnp.float64, "k", 1.0, raising=False)
    return lambda: jnp.float64.k, lambda: patch.setattr(jnp.float64, "k", 2.0)


@way
def a_function_of_this_package_replaced(patch, path):
    return lambda: js.multi_indices(1, 1)[1][0] * 1.0, lambda: patch.setattr(js, "multi_indices", lambda *_: [0, [2]])


@way
def a_setting_of_jax(patch, path):
    return (
        lambda: 2.0 if jax.config.jax_log_compiles else 1.0,
        lambda: patch.setattr(type(jax.config), "jax_log_compiles", True, raising=False),
    )
