"""The data card ``README.md``: YAML front matter of data hubs, then what a stranger has to know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.data.schema import GEOMETRY_NAME, LEADING_AXES
from mbtf_core.files.atomic import Stored
from mbtf_core.units import size_text
from mbtf_gen.publishing.digests import DIGESTS_NAME
from mbtf_gen.publishing.escape import code, escaped, fenced, table
from mbtf_gen.publishing.facts import TAGS, Facts, bound_text
from mbtf_gen.publishing.folder import DATA, PICTURES, RECIPE
from mbtf_gen.publishing.loading import loading_section, same_shapes
from mbtf_gen.publishing.recipe import MATERIAL, remake_call, remake_commands
from mbtf_gen.publishing.statistics import SplitStatistics

CARD_NAME = "README.md"
_SUFFIXES = {"parquet": ".parquet", "webdataset": ".tar"}
# Identifiers of licenses that Hugging Face lists, in its lower-case spelling.
_HUB_LICENSES = {
    *("apache-2.0", "mit", "cc0-1.0", "cc-by-2.0", "cc-by-2.5", "cc-by-3.0", "cc-by-4.0", "cc-by-sa-3.0"),
    *("cc-by-sa-4.0", "cc-by-nc-2.0", "cc-by-nc-3.0", "cc-by-nc-4.0", "cc-by-nd-4.0", "cc-by-nc-nd-3.0"),
    *("cc-by-nc-nd-4.0", "cc-by-nc-sa-2.0", "cc-by-nc-sa-3.0", "cc-by-nc-sa-4.0", "cdla-sharing-1.0"),
    *("cdla-permissive-1.0", "cdla-permissive-2.0", "odbl", "odc-by", "pddl", "unlicense", "wtfpl"),
    *("bsd-2-clause", "bsd-3-clause", "gpl-3.0", "lgpl-3.0", "agpl-3.0", "mpl-2.0", "isc", "zlib"),
}
_HUB_NAMES = {"odbl-1.0": "odbl", "odc-by-1.0": "odc-by", "pddl-1.0": "pddl"}
_CAPTIONS = {
    "tile.png": "The tile from above: mean value of the training queries per position, over views within 32° "
    "of the normal. Drawn from the stored values; pixels with few queries are averaged with their neighbors.",
    "brdf.png": "Apparent BRDF: mean value over the tile by direction of view, for three elevations of "
    "the light (star). Both directions are turned until the light lies on the right. Gray: no data.",
    "values.png": "Values of all queries, queries per level of detail, and their noise with error bars of "
    "one standard error.",
    "queries.png": "Positions, levels and directions of the training queries.",
    "surface.png": "The surface as simulated, from `geometry.exr`.",
}


@dataclass(frozen=True)
class Card:
    """What the data card is written from.

    Attributes
    ----------
    facts : Facts
        The data set and what its publishers say.
    splits : mapping
        :meth:`~mbtf_gen.publishing.facts.Facts.fields` of each split.
    statistics : mapping
        Statistics of each split.
    files : mapping of str to Stored
        The published files by name.
    maps : bool
        Whether the input files of the material are published.
    """

    facts: Facts
    splits: Mapping[str, Mapping[str, Mapping[str, Any]]]
    statistics: Mapping[str, SplitStatistics]
    files: Mapping[str, Stored]
    maps: bool

    @property
    def text(self) -> str:
        """The whole file."""
        sections = [
            self._front_matter(),
            f"# {escaped(self.facts.name)}",
            escaped(self.facts.summary) + " " + self._origin(),
            self._picture("tile.png"),
            self._queries(),
            self._fields(),
            loading_section(self.facts, self.splits),
            self._statistics(),
            self._effects(),
            self._surface(),
            self._made(),
            self._limits(),
            self._files(),
            self._license(),
        ]
        return "\n\n".join(section for section in sections if section) + "\n"

    def _front_matter(self) -> str:
        facts, config = self.facts, self.facts.config
        lower = config.license.lower()
        hub = _HUB_NAMES.get(lower, lower)
        terms = (
            {"license": hub} if hub in _HUB_LICENSES else {"license": "other", "license_name": config.license}
        )
        data: dict[str, Any] = {
            **terms,
            "pretty_name": facts.name,
            "tags": list(TAGS),
            "size_categories": [facts.size_category],
        }
        suffix = _SUFFIXES.get(config.form)
        if suffix is not None:
            files = [{"split": split, "path": f"{DATA}/{split}-*{suffix}"} for split in self.splits]
            data["configs"] = [{"config_name": "default", "data_files": files}]
            if not same_shapes(self.splits):
                # Rows of one configuration must have one shape.
                data["configs"] = [{"config_name": file["split"], "data_files": [file]} for file in files]
        return f"---\n{dump_yaml(data)}---"

    def _origin(self) -> str:
        measured = self.facts.measured
        version = escaped(str(self.facts.manifest["software"].get("mbtf", "")))
        if measured:
            return f"Imported by mbtf {version} from the file {code(str(measured['file']))}."
        return f"Generated by mbtf {version}."

    def _picture(self, name: str) -> str:
        if f"{PICTURES}/{name}" not in self.files:
            return ""
        return f"![{escaped(_CAPTIONS[name].split(':')[0])}]({PICTURES}/{name})\n\n*{_CAPTIONS[name]}*"

    def _queries(self) -> str:
        conventions = self.facts.manifest["conventions"]
        lattice = self.facts.data.lattice
        rows, columns = lattice.shape()
        return "\n\n".join(
            [
                "## What a query is",
                "The data sample the multi-resolution BTF M(u, σ, ω_i, ω_o) in 1/sr. It is the radiance that "
                "leaves the position u towards ω_o, averaged over a Gaussian footprint σ. The light comes "
                "from ω_i and gives the reference plane the irradiance 1. "
                f"The finest level {lattice.finest} has {columns} × {rows} texels. "
                f"One row is {self.facts.layout}.",
                table(
                    ("convention", "meaning"),
                    ((code(str(key)), escaped(str(text))) for key, text in conventions.items()),
                ),
            ]
        )

    def _fields(self) -> str:
        axes = LEADING_AXES[self.facts.data.layout][1:]
        first = next(iter(self.splits.values()), {})
        rows = []
        for name, field in first.items():
            shapes = {split: _shape(fields[name]["shape"]) for split, fields in self.splits.items()}
            unique = list(dict.fromkeys(shapes.values()))
            shown = (
                unique[0] if len(unique) == 1 else "; ".join(f"{s}: {shape}" for s, shape in shapes.items())
            )
            rows.append((code(name), shown, escaped(field["unit"]), escaped(field["meaning"])))
        leading = f" The first axes are {' and '.join(axes)}." if axes else ""
        note = (
            "The value of a query is `(value_a + value_b) / 2`, and `(value_a - value_b)² / 4` estimates its "
            "variance without bias; one pair says little, so average over many."
            if self.facts.data.estimates == 2
            else "`value_a` is the only value of a query; its noise is unknown."
        )
        return "\n\n".join(
            [
                "## Fields",
                f"All numbers are float32.{leading}",
                table(("field", "shape of a row", "unit", "meaning"), rows),
                note,
            ]
        )

    def _statistics(self) -> str:
        rows = []
        for name, found in self.statistics.items():
            noise = found.noise()
            channels = ", ".join(str(found.mean(channel)) for channel in range(3))
            rows.append(
                (
                    name,
                    f"{found.queries:,}",
                    channels,
                    "unknown" if noise is None else f"{noise.scaled(100)} %",
                    f"{found.quantile(0.5):.2g}",
                    f"{found.quantile(0.999):.2g}",
                    f"{found.lowest:.3g} to {found.highest:.3g}",
                )
            )
        heads = ("split", "queries", "mean R, G, B in 1/sr", "noise", "median", "99.9 %", "range")
        return "\n\n".join(
            part
            for part in (
                "## Statistics",
                table(heads, rows),
                "Means and noise have error bars of one standard error, from the scatter over "
                f"{self._units()}. Noise is the pooled standard error of the value of one query, relative to "
                "the mean value. It averages out over many queries.",
                self._picture("brdf.png"),
                self._picture("values.png"),
                self._picture("queries.png"),
            )
            if part
        )

    def _units(self) -> str:
        return {"shuffled": "queries", "image": "images", "slices": "positions"}[self.facts.data.layout]

    def _effects(self) -> str:
        plan = self.facts.manifest.get("effects")
        if not plan:
            return ""
        depth = f"at most {plan['max_depth']}" if plan["max_depth"] else "no limit"
        total = bound_text(plan.get("bias_bound"), 0.0)
        return "\n\n".join(
            [
                "## Simulated effects",
                table(
                    ("effect", "state", "bias without it", "why"),
                    ((escaped(a), b, c, escaped(d)) for a, b, c, d in self.facts.effects),
                ),
                "Biases are root mean square changes of M relative to its mean: upper bounds where the "
                "effect is left out, estimates where it is simulated. All that is left out adds up to "
                f"{total} at most. Surface interactions per path: {depth}.",
            ]
        )

    def _surface(self) -> str:
        if f"{DATA}/{GEOMETRY_NAME}" not in self.files:
            return ""
        return "\n\n".join(
            [
                "## Surface",
                f"`{DATA}/{GEOMETRY_NAME}` holds the heights as traced, mean slopes with their second "
                "moments, and the reflectance that the generator knew. Any EXR viewer opens it.",
                self._picture("surface.png"),
            ]
        )

    def _made(self) -> str:
        facts, manifest = self.facts, self.facts.manifest
        inputs = table(
            ("input", "SHA-256"),
            ((code(str(role)), code(str(digest))) for role, digest in sorted(manifest["inputs"].items())),
        )
        software = ", ".join(f"{escaped(str(k))} {escaped(str(v))}" for k, v in manifest["software"].items())
        if facts.measured:
            return "\n\n".join(
                [
                    "## How it was made",
                    "The values are measured data, converted by `mbtf-gen import`. There is no recipe: the "
                    "data cannot be made again without the measurement.",
                    inputs,
                    f"Software: {software}.",
                ]
            )
        whose = (
            f"The input files of the material are in `{RECIPE}/{MATERIAL}`."
            if self.maps
            else "`MATERIAL` is the path of the material, whose files are not published. These are their "
            "digests; `settings` covers its constants and options."
        )
        return "\n\n".join(
            [
                "## How it was made",
                "These commands make the same data set again and compare every array with the published "
                "one. They run in this folder:",
                fenced("\n".join(remake_commands(self.maps))),
                f"`{remake_call(self.maps)}` runs both. {whose}",
                inputs,
                "The queries are equal bit by bit on every machine. The values are equal bit by bit on one "
                f"type of machine with this software: {software}.",
                f"`{RECIPE}/{DIGESTS_NAME}` holds the SHA-256 of each array as little-endian float32 numbers "
                "in C order. The published files hold the same numbers.",
            ]
        )

    def _limits(self) -> str:
        facts = self.facts
        lines = ["One material, one tile, three color channels (linear Rec.709 RGB)."]
        if facts.measured:
            lines += [
                "Each query has one value. Its noise, the width of the light and the surface are unknown.",
            ]
            if "images" in facts.measured:
                lines.append(
                    "All footprints are those of a texel of the images; there are no coarser levels."
                )
        else:
            config = facts.manifest["config"]
            lines += [
                "Values are Monte Carlo estimates. Errors of a model include this noise unless both "
                "estimates are used: the mean of (p − a)(p − b) is the squared error of a prediction p "
                "without it.",
                "The cosine of both directions to the normal is at least "
                f"{config['queries']['min_cos']:g}. The light has a width of {config['light']['width']:g}° "
                "(RMS per axis).",
                "Geometric optics: no diffraction, no polarization, no fluorescence.",
            ]
        return "\n\n".join(["## Limits", "\n".join(f"- {line}" for line in lines)])

    def _files(self) -> str:
        groups: dict[str, list[Stored]] = {}
        for name, stored in self.files.items():
            folder, _, base = name.rpartition("/")
            split = base.rpartition("-")[0]
            of_split = folder == DATA and split in self.splits
            shown = f"{folder}/{split}-*" if of_split else name if folder == DATA else f"{folder}/*"
            groups.setdefault(shown, []).append(stored)
        rows = [
            (code(name), str(len(found)), size_text(sum(stored.bytes for stored in found)))
            for name, found in groups.items()
        ]
        described = (
            "`croissant.json` describes the data set to programs and lists the SHA-256 of these files."
        )
        return "\n\n".join(["## Files", table(("file", "number", "size"), rows), described])

    def _license(self) -> str:
        config = self.facts.config
        lines = [f"License of the data: {escaped(config.license)}."]
        if config.author:
            lines.append(f"Authors: {_listed(config.author)}.")
        if config.date:
            lines.append(f"Published: {config.date}.")
        if config.url:
            lines.append(f"Address: <{config.url}>")
        parts = ["## License and citation", "\n".join(f"- {line}" for line in lines)]
        if config.citation:
            parts += [
                "Cite as:",
                fenced(config.citation, "bibtex" if config.citation.startswith("@") else ""),
            ]
        return "\n\n".join(parts)


def _shape(shape: Sequence[int]) -> str:
    return " × ".join(str(n) for n in shape) or "1"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(escaped(name) for name in names)
