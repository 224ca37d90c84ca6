"""Commands of README, *start* and *how-to* can be run in the order in which they stand."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

from support.documented import in_blocks
from support.paths import ROOT


def pages_in_order() -> list[Path]:
    """README, then the pages that a reader follows, in the order of the table of contents."""
    names = re.findall(r"^(?:start|how-to)/[\w-]+$", (ROOT / "docs/index.md").read_text(), re.MULTILINE)
    return [ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in names)]


def output_of(words: list[str]) -> str | None:
    return words[words.index("-o") + 1] if "-o" in words else None


def configuration(text: str) -> str:
    """A command without the slice, as the slices of a data set share its folder."""
    return re.sub(r" --slice \S+", "", " ".join(text.split()))


def test_inputs_exist_and_no_output_folder_belongs_to_two_commands() -> None:
    made: dict[str, str] = {}
    faults = []
    for page in pages_in_order():
        for shown in in_blocks(page.read_text(), page.name):
            words = shlex.split(shown.text)
            output = output_of(words)
            for word in words[1:]:
                new = word != output and word not in made and not (ROOT / word).exists()
                if new and word.endswith(("/", ".txt", ".yaml")):
                    faults.append(f"{shown.where}: {shown.text}: nothing made {word}")
            if output and made.setdefault(output, configuration(shown.text)) != configuration(shown.text):
                faults.append(f"{shown.where}: {shown.text}: {output} is that of {made[output]}")
    assert len(made) > 20
    assert faults == []
