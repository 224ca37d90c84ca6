"""Whole chains: data of a size, a fit of a length, and the error that is left on test queries.

Every chain is measured on the same test queries (:mod:`~mbtf_pipeline.cost_study.importance_sampled`), which no training sees. Its parts are the
generator and the fitter themselves, called as the programs call them; nothing is simulated or extrapolated.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mbtf_core.digest import data_sha256
from mbtf_core.stats import Estimate
from mbtf_core.units import parse_duration
from mbtf_gen.config.generator import GeneratorConfig, count_queries
from mbtf_gen.generation import generate
from mbtf_gen.job import Job
from mbtf_gen.material.material import load_material
from mbtf_pipeline.cost_study.generator_benchmark import GeneratorBenchmark
from mbtf_pipeline.cost_study.measurements import Point

if TYPE_CHECKING:
    from mbtf_pipeline.cost_study.importance_sampled import Judges

# A picture of 1080p with one query per pixel.
PIXELS = 1920 * 1080
# Queries of one timed evaluation, and how often it is timed.
_TIMED_QUERIES = 1 << 18
_TIMED = 7
# Test queries of chains' data: chains are judged by others.
_FEWEST = "64"


@dataclass(frozen=True)
class RunRequest:
    """Training data to make: number of queries, paths of each, and what is added to the study's seed."""

    queries: int
    spp: int
    seed: int = 0

    @property
    def other(self) -> str:
        """What names of other seeds end with; nothing for the study's own."""
        return f", seed + {self.seed}" if self.seed else ""


@dataclass(frozen=True)
class Chain:
    """One chain to measure.

    Attributes
    ----------
    study, series, name : see :class:`~mbtf_pipeline.cost_study.measurements.Point`
    data : its training data; what is added to the study's seed is that of the fit, too
    fit : options of the fitter, as its configuration has them
    """

    study: str
    series: str
    name: str
    data: RunRequest
    fit: dict[str, Any] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """What it is called beside all others."""
        # Chains of the study of seeds are named so.
        other = "" if self.study == "seeds" else self.data.other
        return f"{self.study}: {self.series}, {self.name}{other}"

    @property
    def key(self) -> dict[str, Any]:
        """What the point depends on besides the study's basis."""
        return {**asdict(self.data), "fit": self.fit}

    def seconds(self, price: Callable[[int], float], *, data: bool = True) -> float:
        """What it will take, where a query of so many paths takes ``price(paths)`` seconds to generate;
        `data`: the data are still to be made."""
        return data * self.data.queries * price(self.data.spp) + parse_duration(self.fit["training"]["time"])


@dataclass(frozen=True)
class _Data:
    """A data set that was made, and the seconds it took, planning and start included."""

    folder: Path
    seconds: float


class RunRunner:
    """Makes data and fits in a folder of the study, and keeps data that several chains share.

    Parameters
    ----------
    config : the recipe's generator
    folder : to work in; what lies there is removed by :meth:`clear`
    command : of the generator with the study's configuration, to which a chain adds its own options
    progress : called with a note
    """

    def __init__(
        self, config: GeneratorConfig, folder: Path, command: str, progress: Callable[[str], None]
    ) -> None:
        self.config = config
        self.folder = folder
        self.command = command
        self.progress = progress
        self._made: dict[RunRequest, _Data] = {}
        self._judges: Judges | None = None
        self._said = False

    def clear(self) -> None:
        """Remove data and fits; points hold what was measured on them."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _generate(self, wanted: RunRequest) -> _Data:
        """A data set, made anew: what an interrupted study left behind was not timed."""
        data = self.config.model_dump(mode="json")
        data["seed"] += wanted.seed
        data["queries"] |= {
            "train": str(wanted.queries),
            "spp": wanted.spp,
            "test": _FEWEST,
            "test_spp": 2,
            "layout": "shuffled",
        }
        config = GeneratorConfig.model_validate(data)
        folder = self.folder / f"data-{data_sha256(data)[:12]}"
        shutil.rmtree(folder, ignore_errors=True)
        start = time.perf_counter()
        # What is odd about the material is said once, not for every data set.
        said, self._said = self._said, True
        generate(_quiet_job(config) if said else config, folder)
        return _Data(folder, time.perf_counter() - start)

    def data(self, wanted: RunRequest) -> _Data:
        """Training data, made where they are missing."""
        if wanted not in self._made:
            self.progress(f"{wanted.queries / 1e6:.2f} M queries of {wanted.spp} paths{wanted.other}")
            self._made[wanted] = self._generate(wanted)
        return self._made[wanted]

    def has(self, wanted: RunRequest) -> bool:
        """Whether training data are there."""
        return wanted in self._made

    def forget(self, wanted: RunRequest) -> None:
        """Remove training data that no other chain needs."""
        made = self._made.pop(wanted, None)
        if made is not None:
            shutil.rmtree(made.folder, ignore_errors=True)

    def judges(self) -> Judges:
        """The test queries that all chains are judged by, as many paths as the configuration's test split."""
        if self._judges is None:
            from mbtf_pipeline.cost_study.importance_sampled import draw_judges

            self.progress("test queries")
            config, job = self.config, _quiet_job(self.config)
            paths = count_queries(config.queries.test, job.lattice.texels()) * config.queries.test_spp
            self._judges = draw_judges(GeneratorBenchmark(config, job.material, config.seed), paths)
        return self._judges

    def measure(self, chain: Chain) -> Point:
        """Make the data, fit, and judge."""
        from mbtf_fit import FitConfig, fit

        judges = self.judges()
        data = self.data(chain.data)
        self.progress(chain.label)
        config = FitConfig.model_validate({"seed": self.config.seed + chain.data.seed, **chain.fit})
        out = self.folder / f"fit-{data_sha256(chain.key)[:12]}"
        shutil.rmtree(out, ignore_errors=True)
        result = fit(config, data.folder, out)
        material = result.material
        error = judges.unexplained(material.predict(judges.queries))
        half = judges.unexplained(_half(material).predict(judges.queries))
        size = sum(p.stat().st_size for p in out.glob("weights*"))
        numbers = sum(p.numel() for p in material.model.parameters())
        details = {
            "queries": float(chain.data.queries),
            "spp": float(chain.data.spp),
            "generation_seconds": data.seconds,
            "training_seconds": result.seconds,
            "total_seconds": data.seconds + result.total_seconds,
            "evaluation_ms_1080p": 1e3 * _evaluation_seconds(material, judges.queries),
            "bytes": float(size),
            "half_bytes": float(size - 2 * numbers),
            "half_error": half.value,
            "half_error_se": half.error,
        }
        shutil.rmtree(out, ignore_errors=True)
        price = {"data": "generation_seconds", "seeds": "generation_seconds", "fit": "training_seconds"}.get(
            chain.study, "total_seconds"
        )
        return Point(
            chain.study,
            chain.series,
            chain.name,
            {
                "queries.train": str(chain.data.queries),
                "queries.spp": chain.data.spp,
                **_flat(chain.fit),
                **({"seed": self.config.seed + chain.data.seed} if chain.data.seed else {}),
            },
            "",
            Estimate(details[price], 0.0, 1),
            error,
            details=details,
        )

    def command_of(self, chain: Chain) -> str:
        """What makes a chain with the programs."""
        fit = _flat(chain.fit)
        own = ""
        if seed := self.config.seed + chain.data.seed:
            # Also what the generator's configuration holds already, where the chain is of the study's own.
            fit["seed"] = seed
            own = f" --set seed={seed}"
        flags = "".join(f" --set {name}={value}" for name, value in fit.items())
        return (
            f"{self.command} --queries {chain.data.queries} --spp {chain.data.spp}{own} -o shards/ && "
            f"mbtf-fit shards/{flags} -o material/"
        )


def _quiet_job(config: GeneratorConfig) -> Job:
    """The job of a configuration whose material was spoken of before."""
    return Job(config, load_material(Path(config.material), config.geometry.make_tileable))


def _flat(options: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested options by dotted name."""
    out: dict[str, Any] = {}
    for name, value in options.items():
        out |= _flat(value, f"{prefix}{name}.") if isinstance(value, dict) else {f"{prefix}{name}": value}
    return out


def _half(material: Any) -> Any:
    """The material with its numbers rounded to half precision, evaluated in single."""
    import copy

    import torch

    rounded = copy.deepcopy(material)
    with torch.no_grad():
        for parameter in rounded.model.parameters():
            parameter.copy_(parameter.half().float())
    return rounded


def _evaluation_seconds(material: Any, test: Any) -> float:
    """Seconds for one query per pixel of 1080p, at random queries."""
    rows = np.resize(np.arange(len(test)), _TIMED_QUERIES)
    arrays = [getattr(test, name)[rows] for name in ("u", "sigma", "omega_i", "omega_o")]
    took = []
    for _ in range(_TIMED):
        start = time.perf_counter()
        material.evaluate(*arrays)
        took.append(time.perf_counter() - start)
    # Disks still write what was generated: the least is what evaluating takes.
    return min(took) * PIXELS / _TIMED_QUERIES
