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

# Below so many steps, the error itself says little.
_UNTRAINED = 100
# Relative standard error of the test error from which more test queries come first.
_UNCERTAIN = 0.25


@dataclass(frozen=True)
class NextStep:
    """The most useful change after a fit.

    Attributes
    ----------
    kind : what to take more of: test queries, training time, training queries; or nothing
    reason : one sentence
    factor : of the training time or its steps
    """

    kind: Literal["test", "time", "queries", "none"]
    reason: str
    factor: int = 2

    def command(self, config: FitConfig, seconds: float, data: Dataset, material: Path) -> str | None:
        """The whole command, which writes to new folders; None where there is nothing to do, or where the
        data are of an unknown source.

        Parameters
        ----------
        config : of the fit
        seconds : that it was trained for
        data : its data set
        material : its folder
        """
        fitted = ["--config", str(material / "config.yaml")]
        out = ["-o", _numbered(str(material))]
        if self.kind == "none":
            return None
        if self.kind == "time":
            training = config.training
            more = ["--time", _times_as_long(training.time.seconds, seconds, self.factor)]
            if training.steps is not None:
                more = ["--steps", str(self.factor * training.steps)]
            return shlex.join(["mbtf-fit", str(data.folder), *fitted, *more, *out])
        made, shards = data.manifest.get("config") or {}, _numbered(str(data.folder))
        if not {"material", "queries"} <= made.keys():
            # Measured, which have no path of their file, or of another program.
            return None
        words = ["mbtf-gen", made["material"], "--config", str(data.folder.at(CONFIG_NAME))]
        if self.kind == "queries":
            words += ["--queries", _times(made["queries"]["train"], 2)]
        else:
            # The training queries need not be made again; those of other layouts come in large units.
            words += ["--queries", "1"] if data.layout == "shuffled" else []
            words += ["--test-queries", _times(made["queries"]["test"], 4)]
            words += [] if made["queries"].get("test_highlights") else ["--test-highlights", "75%"]
        words += ["-o", shards]
        then = ["mbtf-fit", shards, *fitted, *out]
        if self.kind == "test":
            then = ["mbtf-fit", "evaluate", str(material), shards]
        return f"{shlex.join(words)} && {shlex.join(then)}"


def next_step(cost: MarginalCost, errors: Mapping[str, Any]) -> NextStep:
    """What the evidence says pays most.

    Parameters
    ----------
    cost : of the fit
    errors : by split
    """
    split = errors[headline(errors)]
    own = errors["training"]["unexplained"]["value"] if "training" in errors else None
    value, error = split["unexplained"]["value"], split["unexplained"]["error"]
    untrained = cost.steps < _UNTRAINED and cost.doubling is None
    data = 1.0 if cost.noise_share is None else 1.0 - 0.5 * cost.noise_share
    if cost.few and (value is None or value >= 1.0 or untrained):
        factor = 2 ** math.ceil(math.log2(FEWEST_STEPS / cost.steps))
        return NextStep("time", f"{cost.steps} steps are few: train {factor} times as long", factor)
    if value is None or error is None or error > _UNCERTAIN * abs(value) or unreliable(split):
        reason = "few test queries decide the error; four times as many, by highlights, measure it better"
        if data < FLAT:
            reason += "; the fit overfits noise: then, more training queries help"
        return NextStep("test", reason)
    if value >= 1.0 and own is not None and own < 1.0:
        return NextStep("queries", "the training queries are too few or too noisy")
    if cost.kept_step is not None:
        reason = f"the fit overfits noise after {cost.kept_step} steps; "
        reason += (
            "twice the queries let it train longer"
            if data >= FLAT
            else (f"expect at most {data:.2g} of this error with twice the queries")
        )
        return NextStep("queries", reason)
    time = cost.doubling
    if data < min(FLAT, 1.0 if time is None else time):
        reason = f"the fit overfits noise; expect about {data:.2g} of this error with twice the queries"
        return NextStep("queries", reason)
    if time is None:
        reason = f"{cost.steps} steps are few" if cost.few else "it is unknown what longer training gains"
        return NextStep("time", f"{reason}; try twice the training")
    if time < FLAT or cost.few:
        return NextStep("time", f"expect about {time:.2g} of this error after twice the training")
    return NextStep("none", "neither twice the training nor twice the queries would reduce the error by 5%")


def _numbered(folder: str) -> str:
    """Name of the next folder: ``material-2`` after ``material``, ``material-10`` after ``material-9``, but
    ``rock-16-2`` after ``rock-16``: numbers from 16 are resolutions."""
    stem, digits = re.fullmatch(r"(.*?)(?:-([2-9]|1[0-5]))?/*", folder, re.DOTALL).groups()  # type: ignore[union-attr]
    return f"{stem}-{int(digits or 1) + 1}"


def _times_as_long(planned: float, spent: float, factor: int) -> str:
    """A multiple of a time, which was exceeded where the least number of steps took longer."""
    if spent <= 1.1 * planned:
        return format_duration(factor * planned)
    return format_duration(10.0 * math.ceil(0.1 * factor * spent))


def _times(count: str, factor: int) -> str:
    """A number of queries, or of queries per texel, times a factor."""
    number, slash, unit = count.partition("/")
    return f"{factor * float(number):.15g}{slash}{unit}"
