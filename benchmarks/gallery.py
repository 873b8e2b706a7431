"""The examples of docs/gallery, run and drawn: ``python -m benchmarks.gallery [name ...]``."""

import time
import warnings
from pathlib import Path

import matplotlib

from benchmarks.commandline import arguments

EXAMPLES = sorted((Path(__file__).parent.parent / "docs" / "gallery").glob("*.py"))


def run(path):
    """The figure that an example leaves; its assertion has held then."""
    matplotlib.use("Agg")
    plt = __import__("matplotlib.pyplot").pyplot
    plt.close("all")
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "FigureCanvasAgg is non-interactive")
        exec(compile(path.read_text(), str(path), "exec"), {"__name__": "__main__"})
    return plt.gcf()


def saved(figure, path):
    """A small file: few colours are enough for contours and lines."""
    from PIL import Image

    figure.savefig(path, dpi=90)
    Image.open(path).convert("RGB").quantize(96, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    given = arguments(__doc__, names="example").names
    for path in EXAMPLES:
        if not given or path.stem in given:
            start = time.process_time()
            saved(run(path), path.with_suffix(".png"))
            print(f"{path.stem:20} {time.process_time() - start:6.1f} s  {path.with_suffix('.png').stat().st_size}")
