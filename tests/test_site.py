"""The site as it is built: the reference is whole, formulas are rendered, nothing comes from another host."""

import functools
import html
import http.server
import inspect
import json
import re
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest

import jsmitsm

ROOT = Path(__file__).parent.parent
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
HIDDEN = {"tree_flatten", "tree_unflatten", "refuse_stacked", "recorded", "as_written"}
MODULES = ("files", "plot", "sdf")


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The folder of the built site; warnings, such as links to nowhere, fail the build."""
    for name in ("material", "mkdocstrings", "latex2mathml"):
        pytest.importorskip(name, reason='pip install ".[docs]"')
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert made.returncode == 0, made.stdout + made.stderr
    return folder


@pytest.fixture(scope="module")
def entries(site):
    """The HTML of every entry of the reference, by its anchor: to where the next entry begins."""
    found = {}
    for page in (site / "reference.html", *(site / "reference").glob("*.html")):
        text = page.read_text()
        starts = [(m.start(), m[1]) for m in re.finditer(r'<h\d id="(jsmitsm[^"]*)" class="doc', text)]
        for (start, name), (end, _) in zip(starts, [*starts[1:], (len(text), "")]):
            found[name] = text[start:end]
    return found


def methods(name, thing):
    """The public methods of a class that stand in its own body, by the names they are told under."""
    own = [k for k, v in vars(thing).items() if inspect.isfunction(v) and not k.startswith("_") and k not in HIDDEN]
    own = [k for k in own if vars(thing)[k].__doc__]  # one that overrides another without a word is told there
    return [f"{name}.{k}" for k in own] + ([f"{name}.__call__"] if "__call__" in vars(thing) else [])


def functions():
    """Every public function and method with its signature."""
    for name in jsmitsm.__all__:
        thing = getattr(jsmitsm, name)
        if inspect.isclass(thing):
            for method in methods(name, thing):
                yield method, functools.reduce(getattr, method.split(".")[1:], thing)
        elif inspect.isfunction(thing) or inspect.isfunction(inspect.unwrap(thing) if callable(thing) else None):
            yield name, thing
        elif name in MODULES:
            listed = [k for k in thing.__all__ if getattr(thing, k).__name__ == k]  # not the second names of shapes
            yield from ((f"{name}.{k}", getattr(thing, k)) for k in listed)


def test_every_public_name_has_an_entry(entries):
    missing = [name for name in jsmitsm.__all__ if f"jsmitsm.{name}" not in entries]
    assert not missing, missing
    twice = [name for name in entries if re.search(r"\.(\w+)\.\1$", name)]
    assert not twice, f"the path of a module, not the public one: {twice}"


@pytest.mark.parametrize(("name", "function"), list(functions()), ids=lambda x: x if isinstance(x, str) else "")
def test_functions_and_methods_are_told_whole(entries, name, function):
    """Every parameter by name, what is returned, and an example."""
    entry = entries[f"jsmitsm.{name}"]
    parameters = [p for p in inspect.signature(function).parameters if p != "self"]
    told = html.unescape(re.sub(r"<[^>]+>", "", entry))
    listed = told.partition("Parameters:")[2].partition("Returns:")[0]
    untold = [parameter for parameter in parameters if not re.search(rf"\b{parameter}\b", listed)]
    assert not untold, f"{untold} not told"
    assert ">>>" in told, "no example"
    returns = inspect.signature(function).return_annotation
    if returns not in (None, "None", inspect.Signature.empty) and name != "no_progress":
        assert "Returns:" in told, "what it returns is not told"


def test_classes_have_an_example_and_no_description_is_empty(entries):
    for name in jsmitsm.__all__:
        if inspect.isclass(getattr(jsmitsm, name)):
            assert "&gt;&gt;&gt;" in entries[f"jsmitsm.{name}"], name
    empty = [name for name, entry in entries.items() if re.search(r"–\s*</p>|–\s*</li>|–\s*</div>", entry)]
    assert not empty, empty


def test_nothing_is_raw_and_nothing_comes_from_another_host(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        visible = re.sub(r"<script.*?</script>", "", text, flags=re.S)
        assert not re.search(r":(func|class|meth|mod|attr):", visible), page.name
        assert "arithmatex" not in text and not re.search(r"\\(frac|sum|partial|nabla)\b", visible), page.name
        fetched = re.findall(r'<(?:script|img|link|iframe)[^>]*(?:src|href)="(https?://[^"]*)"', text)
        assert not fetched, (page.name, fetched)
    assert "<math" in (site / "methods.html").read_text()


PROBE = """<script>
addEventListener("error", e => parent.errors.push(location.pathname + " " + e.message));
addEventListener("load", () => setTimeout(() => {
  const wide = [...document.querySelectorAll("article *")].filter(e => {
    for (let p = e; p && p.tagName != "BODY"; p = p.parentElement)
      if (["auto", "scroll", "hidden"].includes(getComputedStyle(p).overflowX)) return false;
    return e.getClientRects().length && e.getBoundingClientRect().right > innerWidth + 1;
  });
  const flat = [...document.querySelectorAll("math")].filter(e => e.getBoundingClientRect().height < 4);
  parent.seen[location.pathname.slice(1)] = {wide: wide.slice(0, 3).map(e => e.outerHTML.slice(0, 90)),
    flat: flat.length, scrolls: document.documentElement.scrollWidth > innerWidth + 1};
}, 200));
</script>"""
FRAME = """<body><script>
errors = []; seen = {};
setInterval(() => document.body.dataset.seen = JSON.stringify({errors, seen}), 100);
</script>"""


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
@pytest.mark.parametrize("width", [1400, 390])
def test_pages_in_chromium(site, width, tmp_path):
    """No error of a script, no text beyond the edge, every formula with a height, on every page."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    copy = tmp_path / "site"
    shutil.copytree(site, copy)
    pages = sorted(str(p.relative_to(copy)) for p in copy.rglob("*.html") if p.name != "404.html")
    for page in pages:
        text = (copy / page).read_text()
        (copy / page).write_text(text.replace("<head>", "<head>" + PROBE, 1))
    # Headless windows are at least 500 wide: frames of the width stand in for telephones, all pages in one window.
    frames = "".join(f'<iframe src="{page}" width={width} height=900></iframe>' for page in pages)
    (copy / "frame.html").write_text(FRAME + frames)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler, directory=str(copy)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
               "--enable-logging=stderr", "--virtual-time-budget=20000", "--window-size=1600,900"]  # fmt: skip
    address = f"http://127.0.0.1:{server.server_port}/frame.html"
    try:
        made = subprocess.run([CHROMIUM, *options, "--dump-dom", address], capture_output=True, text=True, timeout=600)
    finally:
        server.shutdown()
    found = re.search(r'data-seen="([^"]*)"', made.stdout)
    assert found, made.stderr[-500:]
    told = json.loads(html.unescape(found[1]))
    assert sorted(told["seen"]) == pages, set(pages) - set(told["seen"])
    bad = {page: what for page, what in told["seen"].items() if what["wide"] or what["flat"] or what["scrolls"]}
    assert not bad and not told["errors"], (width, bad, told["errors"])
    assert not re.findall(r"CONSOLE.*(?:Uncaught|Failed to load).*", made.stderr)
