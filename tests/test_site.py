"""The site as it is built: the reference is whole, formulas are rendered, nothing comes from another host."""

import functools
import html
import http.server
import inspect
import json
import queue
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
    # Words after a list of errors are taken for errors: they belong under "Notes".
    for name, entry in entries.items():
        raised = entry.partition("Raises:")[2].partition("Examples:")[0].partition("</ul>")[0]
        for item in re.findall(r"<li[^>]*>(.*?)</li>", raised, re.S):
            said = " ".join(re.sub(r"<[^>]+>", "", item).split())
            assert re.match(r"[\w.]+ –", said), f"{name}: {said}"


def test_nothing_is_raw_and_nothing_comes_from_another_host(site):
    for page in site.rglob("*.html"):
        text = page.read_text()
        visible = re.sub(r"<script.*?</script>", "", text, flags=re.S)
        assert not re.search(r":(func|class|meth|mod|attr):", visible), page.name
        assert "arithmatex" not in text and not re.search(r"\\(frac|sum|partial|nabla)\b", visible), page.name
        blocks = "".join(re.findall(r"<code>(?:<span|<a).*?</code>", visible, re.S))
        code = html.unescape(re.sub(r"<[^>]+>", "", blocks))
        wide = [line for line in code.splitlines() if line.startswith((">>> ", "... ")) and len(line) > 84]
        assert not wide, (page.name, wide)
        assert not re.search(r"\\\(", re.sub(r"<(code|pre)\b.*?</\1>", "", visible, flags=re.S)), page.name
        fetched = re.findall(r'<(?:script|img|link|iframe)[^>]*(?:src|href)="(https?://[^"]*)"', text)
        assert not fetched, (page.name, fetched)
    assert "<math" in (site / "methods.html").read_text()


# One browser and one frame for all pages: each is measured as on a desk, then as on a telephone (headless windows are
# at least 500 wide, frames are not). The search index, which every page would build again, is empty meanwhile; a whole
# one is searched at the end.
DRIVER = """<body><iframe id="frame" height="900"></iframe><script>
const frame = document.getElementById("frame"), pages = PAGES, seen = {}, errors = [];
const pause = time => new Promise(done => setTimeout(done, time));
const opened = address => new Promise(done => { frame.onload = done; frame.src = address; });
function measured() {
  const view = frame.contentWindow, page = frame.contentDocument, style = view.getComputedStyle.bind(view);
  const wide = [...page.querySelectorAll("article *")].filter(e => {
    if (!e.getClientRects().length || e.getBoundingClientRect().right <= view.innerWidth + 1) return false;
    for (let p = e; p && p.tagName != "BODY"; p = p.parentElement)
      if (["auto", "scroll", "hidden"].includes(style(p).overflowX)) return false;
    return true;
  });
  const flat = [...page.querySelectorAll("math")].filter(e => e.getBoundingClientRect().height < 4);
  return {wide: wide.slice(0, 3).map(e => e.outerHTML.slice(0, 90)), flat: flat.length,
          scrolls: page.documentElement.scrollWidth > view.innerWidth + 1};
}
async function all() {
  for (const page of pages) {
    frame.width = 1400;
    await opened(page);
    seen[page] = [];
    for (const width of [1400, 390]) {
      frame.width = width;
      await pause(60);
      seen[page].push(measured());
    }
  }
  frame.width = 1400;
  await fetch("/whole-index");
  await opened("index.html");
  const field = frame.contentDocument.querySelector(".md-search__input");
  field.focus();
  field.value = "Helmholtz";
  for (const kind of ["input", "keyup"]) field.dispatchEvent(new Event(kind, {bubbles: true}));
  const results = () => [...frame.contentDocument.querySelectorAll(".md-search-result__item a")];
  for (let k = 0; k < 200 && !results().length; k++) await pause(100);
  return {seen, found: results().map(e => e.getAttribute("href"))};
}
all().then(told => told, error => ({failed: String(error), seen})).then(
  told => fetch("/told", {method: "POST", body: JSON.stringify(told)}));
</script>"""


def served(folder, driver, told):
    """A class of handlers for the site, the page that walks through it, and what that page tells in the end."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        whole = False

        def __init__(self, *given):
            super().__init__(*given, directory=str(folder))

        def log_message(self, *_):
            pass

        def answer(self, body, kind="text/html"):
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def do_GET(self):
            if self.path == "/driver.html":
                self.answer(driver.encode())
            elif self.path == "/whole-index":
                Handler.whole = True
                self.answer(b"")
            elif self.path.endswith("search_index.json") and not Handler.whole:
                index = json.loads((folder / "search" / "search_index.json").read_text())
                self.answer(json.dumps({**index, "docs": []}).encode(), "application/json")
            else:
                super().do_GET()

        def do_POST(self):
            told.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
            self.answer(b"")

    return Handler


@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium: apt-get install chromium")
def test_pages_and_search_in_chromium(site, tmp_path):
    """No error of a script, no text beyond the edge, every formula with a height, at 1400 and 390; search finds."""
    pages, told = sorted(str(p.relative_to(site)) for p in site.rglob("*.html") if p.name != "404.html"), queue.Queue()
    handler = served(site, DRIVER.replace("PAGES", json.dumps(pages)), told)
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--no-first-run",
               "--enable-logging=stderr", "--remote-debugging-port=0", "--window-size=1600,900",
               f"--user-data-dir={tmp_path}"]  # fmt: skip
    address = f"http://127.0.0.1:{server.server_port}/driver.html"
    with (tmp_path / "said").open("w+") as said:
        browser = subprocess.Popen([CHROMIUM, *options, address], stdout=subprocess.DEVNULL, stderr=said)
        try:
            answer = told.get(timeout=1200)
        finally:
            browser.terminate()
            browser.wait(30)
            server.shutdown()
        said.seek(0)
        words = said.read()
    assert "failed" not in answer, answer["failed"]
    assert sorted(answer["seen"]) == pages
    bad = {(page, width): what for page, both in answer["seen"].items() for width, what in zip((1400, 390), both)
           if what["wide"] or what["flat"] or what["scrolls"]}  # fmt: skip
    assert not bad, bad
    assert any("problems.html" in place for place in answer["found"]), answer["found"]
    assert not re.findall(r"CONSOLE.*(?:Uncaught|Failed to load|Error).*", words), words[-2000:]
