"""The data card ``README.md``: YAML front matter of data hubs, then what a stranger has to know.

``card.md.j2`` is its text. Names and texts of others are escaped: shown as they are, never read as markup.
"""

from __future__ import annotations

import html
import re
from collections.abc import Mapping
from importlib.resources import files as resources
from typing import Any

import jinja2

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.files.atomic import Stored
from mbtf_core.units import size_text
from mbtf_gen.planning.effects import EFFECTS
from mbtf_gen.publishing.facts import DATA, TAGS, Facts
from mbtf_gen.publishing.picture import PICTURE_NAME
from mbtf_gen.publishing.recipe import material_of
from mbtf_gen.publishing.statistics import split_statistics

CARD_NAME = "README.md"
_SUFFIXES = {"parquet": ".parquet", "webdataset": ".tar"}
# Identifiers of licenses that Hugging Face lists, in its lower-case spelling; it takes all others as "other".
_HUB_LICENSES = re.compile(
    r"apache-2\.0|mit|cc0-1\.0|cc-by(-nc)?(-sa|-nd)?-[234]\.0|cdla-(sharing-1|permissive-[12])\.0|odbl|odc-by|"
    r"pddl|unlicense|wtfpl|bsd-[23]-clause|[al]?gpl-3\.0|mpl-2\.0|isc|zlib"
)
_HUB_NAMES = {"odbl-1.0": "odbl", "odc-by-1.0": "odc-by", "pddl-1.0": "pddl"}
# Names of size categories of data hubs, by powers of ten of the number of rows.
_SIZES = ("1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B", "100B", "1T")
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
    hub = _HUB_NAMES.get(lower, lower)
    terms = {"license": hub}
    if not _HUB_LICENSES.fullmatch(hub):
        terms = {"license": "other", "license_name": facts.config.license}
    rows = sum(shard.rows for shards in facts.shards.values() for shard in shards)
    size = max(0, len(str(rows)) - 3)
    category = "n<1K" if size == 0 else f"{_SIZES[size - 1]}<n<{_SIZES[size]}" if size < 10 else "n>1T"
    data: dict[str, Any] = {
        **terms,
        "pretty_name": facts.name,
        "tags": list(TAGS),
        "size_categories": [category],
    }
    suffix = _SUFFIXES.get(facts.config.form)
    if suffix is not None:
        parts = [{"split": split, "path": f"{DATA}/{split}-*{suffix}"} for split in facts.shards]
        # Rows of one configuration must have one shape.
        groups = {"default": parts} if facts.same_shapes else {part["split"]: [part] for part in parts}
        data["configs"] = [{"config_name": name, "data_files": found} for name, found in groups.items()]
    return dump_yaml(data)


def _bound(effect: Mapping[str, Any]) -> str:
    """Bias bound of an effect with its standard error, in percent of the mean value."""
    if not effect["present"]:
        return ""
    if effect["bias_bound"] is None:
        return "not measured"
    error = f" ± {100 * effect['error']:.1g}" if effect["error"] else ""
    return f"{100 * effect['bias_bound']:.2g}{error} %"


def _grouped(files: Mapping[str, Stored], splits: Mapping[str, Any]) -> dict[str, list[int]]:
    """Sizes of files: shards by split, files of other folders by folder."""
    groups: dict[str, list[int]] = {}
    for name, stored in files.items():
        folder, _, base = name.rpartition("/")
        split = base.rpartition("-")[0]
        shown = name if folder in ("", DATA) else f"{folder}/*"
        shown = f"{folder}/{split}-*" if folder == DATA and split in splits else shown
        groups.setdefault(shown, []).append(stored.bytes)
    return groups


def card_text(facts: Facts, files: Mapping[str, Stored], maps: bool) -> str:
    """The whole file.

    Parameters
    ----------
    facts : Facts
        The data set and what its publishers say.
    files : mapping of str to Stored
        The published files by name.
    maps : bool
        Whether the input files of the material are published.

    Returns
    -------
    str

    Raises
    ------
    InputError
        A shard cannot be read.
    """
    manifest, measured = facts.data.manifest, facts.measured
    version = escaped(manifest["software"].get("mbtf", ""))
    origin = f"Generated by mbtf {version}."
    if measured:
        origin = f"Imported by mbtf {version} from the file {code(measured['file'])}."
    split = "test" if "test" in facts.shards else next(iter(facts.shards))
    fields = {}
    for name in facts.shapes[split]:
        shapes = {s: " × ".join(map(str, shape[name])) or "1" for s, shape in facts.shapes.items()}
        alike = len(set(shapes.values())) == 1
        fields[name] = shapes[split] if alike else "; ".join(f"{s}: {text}" for s, text in shapes.items())
    rows, columns = facts.data.lattice.shape()
    environment = jinja2.Environment(
        undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    environment.filters |= {"text": escaped, "code": code, "fenced": fenced}
    template = resources(__package__).joinpath("card.md.j2").read_text()
    return environment.from_string(template).render(
        front_matter=front_matter(facts),
        name=facts.name,
        summary=facts.summary,
        origin=origin,
        picture=PICTURE_NAME,
        level=facts.data.lattice.finest,
        columns=columns,
        rows=rows,
        row=facts.row,
        manifest=manifest,
        measured=measured,
        fields=fields,
        form=facts.config.form,
        split=split,
        shape=", ".join(str(n) for n in (-1, *facts.shapes[split]["value_a"])),
        configuration="" if facts.same_shapes else f'"{split}", ',
        statistics={name: split_statistics(shards) for name, shards in facts.shards.items()},
        effects=manifest.get("effects"),
        labels={name: effect.description for name, effect in EFFECTS.items()},
        bound=_bound,
        material=material_of(maps),
        maps=maps,
        files=_grouped(files, facts.shards),
        size=size_text,
        config=facts.config,
    )
