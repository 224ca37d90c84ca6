"""The data card ``README.md``: YAML front matter of data hubs, then what a stranger has to know.

``card.md.j2`` is its text. Names and texts of others are escaped: shown as they are, never read as markup.
"""

from __future__ import annotations

import html
import re
from functools import partial
from importlib.resources import files as resources
from typing import Any

import jinja2

from mbtf_core.color import ALBEDO_EXPOSURE, describe_exposure
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.units import size_text
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.planning.effects_plan import bias_text
from mbtf_gen.planning.scene import EffectDecision
from mbtf_gen.publishing.facts import TAGS, Facts
from mbtf_gen.publishing.formats import SUFFIXES

CARD_NAME = "README.md"
# Identifiers of licenses that Hugging Face lists, in its lower-case spelling; it takes all others as "other".
_HUB_LICENSES = re.compile(
    r"apache-2\.0|mit|cc0-1\.0|cc-by(-nc)?(-sa|-nd)?-[234]\.0|cdla-(sharing-1|permissive-[12])\.0|odbl|odc-by|"
    r"pddl|unlicense|wtfpl|bsd-[23]-clause|[al]?gpl-3\.0|mpl-2\.0|isc|zlib"
)
_HUB_NAMES = {"odbl-1.0": "odbl", "odc-by-1.0": "odc-by", "pddl-1.0": "pddl"}
# What Markdown gives a meaning inside a line: markup, cells, formulas, and addresses that become links.
_MARKUP = re.compile(r"[\\`*_\[\]|~$@]|:(?=//)|(?<=www)\.", re.IGNORECASE)


def _plain(text: object) -> str:
    return " ".join("".join(c if c.isprintable() else " " for c in str(text)).split())


def _fence(text: str, least: int) -> str:
    """Backticks that a text does not contain."""
    return "`" * max(least, 1 + max((len(run) for run in re.findall(r"`+", text)), default=0))


def escaped(text: object) -> str:
    """A text inside a line of Markdown, with markup, HTML and addresses made harmless."""
    return html.escape(_MARKUP.sub(r"\\\g<0>", _plain(text)), quote=False)


def code(text: object) -> str:
    """A text as inline code, in as many backticks as it needs."""
    plain = _plain(text)
    padded = f" {plain} " if plain[:1] == "`" or plain[-1:] == "`" else plain
    fence = _fence(plain, 1)
    # A bar would end the cell of a table, even inside code.
    return f"{fence}{padded}{fence}".replace("|", "\\|") if plain else ""


def fenced(text: str) -> str:
    """A text as a block of code, with a fence that it does not contain."""
    fence, language = _fence(text, 3), "bibtex" if text.startswith("@") else ""
    return f"{fence}{language}\n{text}\n{fence}"


def front_matter(facts: Facts) -> str:
    """YAML that data hubs read at the head of a card."""
    lower = facts.config.license.lower()
    data: dict[str, Any] = {"license": _HUB_NAMES.get(lower, lower)}
    if not _HUB_LICENSES.fullmatch(data["license"]):
        data = {"license": "other", "license_name": facts.config.license}
    data |= {"pretty_name": facts.name, "tags": list(TAGS)}
    if facts.config.form != "npz":
        suffix = SUFFIXES[facts.config.form]
        parts = [{"split": split, "path": f"data/{split}-*{suffix}"} for split in facts.samples]
        # Rows of one configuration must have one shape.
        groups = {"default": parts} if facts.same_shapes else {part["split"]: [part] for part in parts}
        data["configs"] = [{"config_name": name, "data_files": found} for name, found in groups.items()]
    return dump_yaml(data)


def _grouped(facts: Facts) -> dict[str, list[int]]:
    """Sizes of files: shards by split, files of other folders by folder."""
    groups: dict[str, list[int]] = {}
    for name, stored in facts.files.items():
        folder, _, base = name.rpartition("/")
        split = base.rpartition("-")[0]
        shown = name if folder in ("", "data") else f"{folder}/*"
        shown = f"{folder}/{split}-*" if folder == "data" and split in facts.samples else shown
        groups.setdefault(shown, []).append(stored.bytes)
    return groups


def _row_shape(facts: Facts, name: str) -> str:
    """Shape of a row of an array, of each split where they differ; not all splits have all arrays."""
    having = {split: arrays[name] for split, arrays in facts.shapes.items() if name in arrays}
    shapes = {split: " × ".join(map(str, shape)) or "1" for split, shape in having.items()}
    texts = set(shapes.values())
    return texts.pop() if len(texts) == 1 else "; ".join(f"{split}: {text}" for split, text in shapes.items())


def card_text(facts: Facts) -> str:
    """The whole file."""
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"text": escaped, "code": code, "fenced": fenced, "size": size_text}
    split = "test" if "test" in facts.samples else next(iter(facts.samples))
    return environment.from_string(resources(__package__).joinpath("card.md.j2").read_text()).render(
        facts=facts,
        exposure=describe_exposure(ALBEDO_EXPOSURE),
        manifest=facts.data.manifest,
        front_matter=front_matter(facts),
        row_shape=partial(_row_shape, facts),
        split=split,
        shape=", ".join(str(n) for n in (-1, *facts.shapes[split]["value_a"])),
        configuration="" if facts.same_shapes else f'"{split}", ',
        labels={name: effect.description for name, effect in EFFECTS.items()},
        bound=lambda effect: bias_text(EffectDecision(**effect)),
        files=_grouped(facts),
    )
