"""Every flag names its place in the documentation, and the place is there."""

import re
from pathlib import Path

from jsmitsm.runtime.errors import SYMPTOMS, explained

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "symptoms.md").read_text()
SOURCE = " ".join(" ".join(path.read_text().split()) for path in (ROOT / "jsmitsm").rglob("*.py")
                  if path.name != "errors.py")  # fmt: skip
SOURCE = re.sub(r'" f?"', "", SOURCE)  # sentences over several lines


def test_every_place_is_on_the_page_and_every_sentence_in_the_code():
    anchors = re.findall(r'<span id="([\w-]+)">', PAGE)
    assert len(anchors) == len(set(anchors))
    assert set(SYMPTOMS.values()) <= set(anchors)
    missing = [words for words in SYMPTOMS if words not in SOURCE]
    assert not missing, missing


def test_a_flag_is_explained_once_and_one_without_a_place_names_the_page():
    once = explained(["Round-off may reach 1e-02 of the solution: widen the supports.", "Something else."])
    assert once == ["Round-off may reach 1e-02 of the solution: widen the supports. (docs: symptoms#round-off)",
                    "Something else. (docs: symptoms)"]  # fmt: skip
    assert explained(once) == once
