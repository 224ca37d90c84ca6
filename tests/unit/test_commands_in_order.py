"""Commands of README, *start* and *how-to* can be run in the order in which they stand."""

from __future__ import annotations

import re
import shlex
from itertools import pairwise
from pathlib import Path

from support.documented import in_blocks
from support.paths import ROOT


def pages_in_order() -> list[Path]:
    """README, then the pages that a reader follows, in the order of the table of contents."""
    names = re.findall(r"^(?:start|how-to)/[\w-]+$", (ROOT / "docs/index.md").read_text(), re.MULTILINE)
    return [ROOT / "README.md", *(ROOT / "docs" / f"{name}.md" for name in names)]


# Output folders of commands without -o; '' is the command without a name.
DEFAULTS = {
    "mbtf-gen": {"": "shards/", "preview": "preview/", "reference": "reference/"},
    "mbtf-fit": {"": "material/", "preview": "preview/"},
}
NAMES = re.compile(r"^[a-z]+$")


def output_of(words: list[str]) -> str | None:
    if "-o" in words:
        return words[words.index("-o") + 1]
    if "--write" in words:
        return f"{Path(words[words.index('--write') + 1]).parent}/"
    name = words[1] if NAMES.match(words[1]) else ""
    return None if "--dry-run" in words else DEFAULTS.get(words[0], {}).get(name)


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
            written = [after for flag, after in pairwise(words) if flag == "--write"]
            for word in words[1:]:
                # A folder, or a file of one.
                known = word in made or f"{Path(word).parent}/" in made or (ROOT / word).exists()
                new = word not in (output, *written) and not known
                if new and word.endswith(("/", ".txt", ".yaml")):
                    faults.append(f"{shown.where}: {shown.text}: nothing made {word}")
            if output and made.setdefault(output, configuration(shown.text)) != configuration(shown.text):
                faults.append(f"{shown.where}: {shown.text}: {output} is that of {made[output]}")
    assert len(made) > 20
    assert faults == []
