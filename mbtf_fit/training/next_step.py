"""What reduces the error of a finished fit most, as one command."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from mbtf_core.data.dataset import Dataset
from mbtf_core.data.schema import CONFIG_NAME
from mbtf_core.units import format_duration
from mbtf_fit.config import FitConfig
from mbtf_fit.formatting import headline, unreliable
from mbtf_fit.training.validation import FEWEST_STEPS, FLAT, MarginalCost

# Below so many steps, the error itself says little; few steps with a larger error are not enough.
_UNTRAINED, _HARDLY = 100, 0.5
# Factor of the error by which twice the training pays more than better data after few steps.
_PAYS = 0.9
# Relative standard error of the test error from which more test queries come first.
_UNCERTAIN = 0.25
# Standard errors of a significant difference.
_SIGNIFICANT = 2.0
# Of an error that is all due to noise, twice the queries remove this share.
_LIMITED = 0.3
_NO_GAIN = "neither twice the training nor twice the queries would reduce the error by 5%"
# Flags of generator and fit, by the key that a recipe has.
_FLAGS = {
    "generate.queries.train": "--queries",
    "generate.queries.test": "--test-queries",
    "fit.training.time": "--time",
    "fit.training.steps": "--steps",
}


@dataclass(frozen=True)
class NextStep:
    """The most useful change after a fit.

    Attributes
    ----------
    kind : what to take more of: test queries, training time, training queries; or nothing
    reason : one sentence
    factor : of the training time or its steps
    test : whether more test queries are needed beside the training queries
    """

    kind: Literal["test", "time", "queries", "none"]
    reason: str
    factor: int = 2
    test: bool = False

    def options(self, config: FitConfig, seconds: float, queries: Mapping[str, Any]) -> dict[str, str]:
        """Options to change, by dotted key as in a recipe: ``generate.queries.train``, ``fit.training.time``;
        of a fit of so many seconds, and data with this section of the generator's configuration."""
        training = config.training
        if self.kind == "time" and training.steps is not None:
            return {"fit.training.steps": str(self.factor * training.steps)}
        if self.kind == "time":
            return {"fit.training.time": _times_as_long(training.time.seconds, seconds, self.factor)}
        more = {"generate.queries.train": _times(queries["train"], 2)} if self.kind == "queries" else {}
        if self.kind == "test" or self.test:
            more["generate.queries.test"] = _times(queries["test"], 4)
        return more

    def command(
        self, config: FitConfig, seconds: float, data: Dataset, material: Path, train: str | None = None
    ) -> str | None:
        """The whole command, which writes to new folders, for a fit of so many seconds in the folder
        `material`; None where there is nothing to do, or where its data are of an unknown source. `train`:
        number of its training queries, where `data` have others."""
        made = data.manifest.get("config") or {}
        trains_here = self.kind == "time" and train is None
        # Measured data have no path of their file, those of another program no configuration.
        if self.kind == "none" or not (trains_here or {"material", "queries"} <= made.keys()):
            return None
        queries = made.get("queries", {})
        more = self.options(config, seconds, queries if train is None else {**queries, "train": train})
        config_file, out = str(material / "config.yaml"), _numbered(str(material))
        fitted = ["--config", config_file, *_flags(more, "fit."), "-o", out]
        if trains_here:
            return shlex.join(["mbtf-fit", str(data.folder), *fitted])
        shards = _numbered(str(data.folder))
        then = ["mbtf-fit", shards, *fitted]
        if self.kind == "test":
            # The training queries need not be made again; those of other layouts come in large units.
            more = {"generate.queries.train": "1"} | more if data.layout == "shuffled" else more
            then = ["mbtf-fit", "evaluate", str(material), shards]
        elif train is not None:
            more = {"generate.queries.train": train} | more
        words = ["mbtf-gen", made["material"], "--config", str(data.folder.at(CONFIG_NAME))]
        return f"{shlex.join([*words, *_flags(more, 'generate.'), '-o', shards])} && {shlex.join(then)}"


def next_step(cost: MarginalCost, errors: Mapping[str, Any]) -> NextStep:
    """What the evidence says pays most: the marginal cost of a fit, and its errors by split."""
    split = errors[headline(errors)]
    own, spread = (errors.get("training", split)["unexplained"][key] for key in ("value", "error"))
    value, error = split["unexplained"]["value"], split["unexplained"]["error"]
    # A fit that kept an earlier state has trained long enough. Others, after few steps, are limited by noise
    # only where it leaves nothing to longer training.
    few = cost.few and cost.kept_step is None
    learns = few and (cost.doubling is None or cost.doubling < _PAYS)
    overfit, limit = (0.0, 0.0) if learns else (0.5 * (cost.noise_share or 0.0), _LIMITED * cost.noise_limit)
    data = 1.0 - max(overfit, limit)
    most = _HARDLY if data >= FLAT else 1.0
    if few and (value is None or value >= most or cost.steps < _UNTRAINED):
        factor = 2 ** math.ceil(math.log2(FEWEST_STEPS / cost.steps))
        return NextStep("time", f"{cost.steps} steps are few: train {factor} times as long", factor)
    short = ""
    if cost.kept_step is not None:
        short = f"the fit overfits noise after {cost.kept_step} steps"
    elif data < FLAT and limit > overfit:
        known = f"{cost.noise:.0%} of the variance of values, {cost.density:.3g} queries per texel"
        short = f"noise of the training queries limits the fit ({known})"
    elif data < FLAT:
        short = "the fit overfits noise"
    elif None not in (value, error, own, spread):
        is_less = value - own > max(0.5 * value, _SIGNIFICANT * math.hypot(error, spread))
        short = "the error of training queries is less than half as large" if is_less else ""
    if (
        value is None
        or error is None
        or error > _UNCERTAIN * abs(value)
        or (unreliable(split) and not learns)
    ):
        better = "four times as many measure it better"
        if not short:
            return NextStep("test", f"few test queries decide the error; {better}")
        reason = f"{short}; twice the queries reduce the error; few test queries decide it: {better}"
        return NextStep("queries", reason, test=True)
    if value >= 1.0 and own is not None and own < 1.0:
        return NextStep("queries", "the training queries are too few or too noisy")
    if cost.kept_step is not None:
        if 1.0 - overfit >= FLAT:
            return NextStep("none", f"{short}; {_NO_GAIN}")
        return NextStep("queries", f"{short}; {_at_best(1.0 - overfit)}")
    time = cost.doubling
    if data < min(FLAT, 1.0 if time is None else time):
        return NextStep("queries", f"{short}; {_at_best(data)}")
    if time is None:
        reason = f"{cost.steps} steps are few" if few else "it is unknown what longer training gains"
        return NextStep("time", f"{reason}; try twice the training")
    if time < FLAT or few:
        return NextStep("time", f"expect about {time:.2g} of this error after twice the training")
    return NextStep("none", _NO_GAIN)


def _at_best(factor: float) -> str:
    # Of cloth by few noisy queries, twice as many have left 0.69 to 0.99 of the error.
    return f"expect {factor:.2g} to 1 of this error with twice the queries"


def _flags(options: Mapping[str, str], section: str) -> list[str]:
    """Flags of the options of a section, ``generate.`` or ``fit.``."""
    given = {_FLAGS[key]: value for key, value in options.items() if key.startswith(section)}
    return [word for flag in given.items() for word in flag]


def _numbered(folder: str) -> str:
    """Name of the next free folder: ``material-2`` after ``material``, ``material-10`` after ``material-9``,
    but ``rock-16-2`` after ``rock-16``: numbers from 16 are resolutions."""
    stem, digits = re.fullmatch(r"(.*?)(?:-([2-9]|1[0-5]))?/*", folder, re.DOTALL).groups()  # type: ignore[union-attr]
    name = f"{stem}-{int(digits or 1) + 1}"
    return _numbered(name) if Path(name).exists() else name


def _times_as_long(planned: float, spent: float, factor: int) -> str:
    """A multiple of a time, which was exceeded where the least number of steps took longer."""
    if spent <= 1.1 * planned:
        return format_duration(factor * planned)
    return format_duration(10.0 * math.ceil(0.1 * factor * spent))


def _times(count: str, factor: int) -> str:
    """A number of queries, or of queries per texel, times a factor."""
    number, slash, unit = count.partition("/")
    return f"{factor * float(number):.15g}{slash}{unit}"
