"""Every path of the project on a GPU against the CPU's results.

    python benchmarks/gpu.py [--out FOLDER] [--steps 1000] [--resolution 64]

One data set of an asset is generated on the CPU. Then follow, each in a process of its own:

- ``mbtf-gen selftest``;
- **estimator**: the values of the test queries on both devices with the same seed. Means agree, and so do the
  values of every level: the product of the differences of both halves has the expectation
  ``(M_gpu - M_cpu)²``, whatever the noise;
- **training** of every model, a tenth of the steps and all: by the compiled kernel, by PyTorch on the CPU,
  and on the device; their test errors agree;
- **materials** fitted on the CPU: conformance values in PyTorch and by the Mitsuba plugin, unrolled, by
  cooperative vectors and in half precision, milliseconds of a 1080p picture, and a ball that the plugin
  renders; where slangpy is installed, conformance values of the Slang module by CUDA, and of its cooperative
  vectors by Vulkan.

A difference passes if it is at most its tolerance plus 4.5 standard errors. Rates are reported only. Without
a CUDA device, nothing is measured and the exit code is 0. The last line is one JSON object: figures, and the
checks. Exit code 1 where a check fails or a process ends early.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from common import ASSETS, finish, parser_of, start
from gpu_measurements import PREDICTIONS, Sizes
from numpy.typing import NDArray

from mbtf_core.run.processes import ChildResult, run_child
from mbtf_core.stats import Estimate, level_groups, mean_estimate, mse_difference, noise_free_mse
from mbtf_gen.diagnostics.selftest import STANDARD_ERRORS

ASSET = ASSETS / "cliff_rock"
# Relative differences that are accepted beside the statistical error: of the mean value; of the values of a
# level, RMS.
MEAN, VALUES = 1e-3, 1e-2
# The same of the test errors of two fits, after a tenth of the steps and after all. Rounding makes fits
# diverge: kernel and PyTorch differ by several percent after 1000 steps.
FIT_BEGUN, FIT = 0.05, 0.2
# Most deviation from conformance values, in single and in half precision.
SINGLE, HALF = 1e-4, 1e-2
ARITHMETICS = {"unrolled": SINGLE, "cooperative": SINGLE, "half": HALF}
SHADERS = {"plain": SINGLE, "cooperative": HALF} if find_spec("slangpy") else {}
# Environment in which PyTorch replaces the compiled kernel.
NO_KERNEL = {"MBTF_KERNEL": "off"}
# Seconds after which a process counts as hanging.
TIMEOUT = 1800.0

# Calls a function of `gpu_measurements` with texts, in another environment.
Run = Callable[[str, tuple[str, ...], Mapping[str, str]], ChildResult]
Arrays = Mapping[str, NDArray[np.float32]]


@dataclass(frozen=True)
class Check:
    """One comparison.

    Attributes
    ----------
    name : what is compared
    difference : what was found; None where a process ended early
    limit : most that passes
    note : why there is no difference, or more about it
    """

    name: str
    difference: float | None
    limit: float = 0.0
    note: str = ""

    @property
    def held(self) -> bool:
        """Whether the difference is within the limit; NaN is not."""
        return self.difference is not None and self.difference <= self.limit

    def line(self) -> str:
        """A row of the table."""
        found = "-" if self.difference is None else f"{self.difference:.2g}"
        verdict = "ok" if self.held else "FAILED"
        return f"{verdict:6s}  {self.name:62s} {found:>9s}  at most {self.limit:.2g}  {self.note}".rstrip()


def compare_mean(name: str, reference: Arrays, other: Arrays, tolerance: float) -> Check:
    """Check of the means of two sets of halves ``value_a``, ``value_b`` (n, 3) at the same places."""
    a, b = _differences(reference, other)
    mean = 0.5 * float((reference["value_a"] + reference["value_b"]).mean(dtype=np.float64))
    shift = mean_estimate(0.5 * (a + b))
    limit = tolerance + STANDARD_ERRORS * shift.error / mean
    return Check(f"{name}: mean value, relative", abs(shift.value) / mean, limit)


def compare_values(name: str, reference: Arrays, other: Arrays) -> Check:
    """Check of two sets of halves ``value_a``, ``value_b`` (n, 3), place by place."""
    apart = _product(*_differences(reference, other))
    scale = _product(reference["value_a"], reference["value_b"]).value
    limit = VALUES**2 + STANDARD_ERRORS * apart.error / scale
    return Check(f"{name}, relative squared", apart.value / scale, limit)


def compare_estimates(reference: Arrays, other: Arrays, finest: int) -> list[Check]:
    """Checks of two sets of halves at the same queries.

    Parameters
    ----------
    reference, other : ``value_a``, ``value_b`` (n, 3) in 1/sr and ``sigma`` (n,) in tile widths
    finest : finest level
    """
    levels = level_groups(reference["sigma"], finest)
    checks = [compare_mean("estimator", reference, other, MEAN)]
    for level in np.unique(levels).tolist():
        chosen = levels == level
        parts = ({name: array[chosen] for name, array in side.items()} for side in (reference, other))
        checks.append(compare_values(f"estimator: values of level {level}", *parts))
    return checks


def _differences(reference: Arrays, other: Arrays) -> tuple[NDArray[Any], NDArray[Any]]:
    """Differences of both halves."""
    a, b = (other[f"value_{half}"].astype(np.float64) - reference[f"value_{half}"] for half in "ab")
    return a, b


def _product(a: NDArray[Any], b: NDArray[Any]) -> Estimate:
    return mean_estimate(np.asarray(a, np.float64) * b)


def compare_fits(name: str, reference: Arrays, other: Arrays, tolerance: float) -> Check:
    """Check of the errors of two fits at the same test queries.

    Parameters
    ----------
    reference, other : ``prediction`` of a fit, ``value_a`` and ``value_b`` of the data (n, 3), in 1/sr
    tolerance : relative
    """
    halves = reference["value_a"], reference["value_b"]
    predictions = reference["prediction"], other["prediction"]
    error = noise_free_mse(predictions[0], *halves).value
    apart = mse_difference(predictions[1], predictions[0], *halves)
    limit = tolerance + STANDARD_ERRORS * apart.error / error
    return Check(name, abs(apart.value) / error, limit)


@dataclass
class Comparison:
    """The comparison of a device with the reference.

    Attributes
    ----------
    run : runs a measurement
    reference, device : ``cpu`` or ``cuda``
    folder : for data and materials
    checks, figures : what was found so far
    """

    run: Run
    reference: str
    device: str
    sizes: Sizes
    folder: Path
    checks: list[Check] = field(default_factory=list)
    figures: dict[str, dict[str, Any]] = field(default_factory=dict)

    def measure(
        self, name: str, function: str, *arguments: str, environment: Mapping[str, str] | None = None
    ) -> dict[str, Any] | None:
        """Answers of a measurement, which are also figures; None and a failed check if it ended early."""
        print(name, file=sys.stderr, flush=True)
        outcome = self.run(function, arguments, environment or {})
        self.figures[name] = {**outcome.answers, "process_seconds": round(outcome.seconds, 2)}
        if outcome.fault:
            self.checks.append(Check(name, None, note=outcome.fault))
            return None
        return outcome.answers

    def all(self) -> None:
        """Run everything that the steps before make possible."""
        self.selftest()
        for layout in ("shuffled", "image"):
            shards = self.folder / layout
            if (
                self.measure(f"data, {layout}", "generate_data", self.sizes.text(), layout, str(shards))
                is None
            ):
                continue
            if layout == "shuffled":
                self.estimator(shards)
            for model in models(layout):
                self.model(model, shards)

    def selftest(self) -> None:
        """The generator's own checks."""
        found = self.measure("selftest", "selftest")
        self.checks += [
            Check(f"selftest: {name}", 0.0 if state == "ok" else None, note="" if state == "ok" else state)
            for name, state in (found or {}).items()
        ]

    def estimator(self, shards: Path) -> None:
        """Values of the test queries."""
        found = self.both("estimator", "estimate", self.sizes.text(), str(shards))
        if found is not None:
            self.checks += compare_estimates(*found, self.sizes.resolution.bit_length() - 1)

    def both(self, name: str, function: str, *arguments: str) -> tuple[Arrays, Arrays] | None:
        """Arrays that a measurement writes on the reference and on the device."""
        found: list[Arrays] = []
        for number, device in enumerate((self.reference, self.device)):
            out = self.folder / f"{name}-{number}.npz"
            if self.measure(f"{name} on {_side(number, device)}", function, device, *arguments, str(out)):
                with np.load(out) as arrays:
                    found.append(dict(arrays))
        return (found[0], found[1]) if len(found) == 2 else None

    def model(self, model: str, shards: Path) -> None:
        """Fits of a model, and its material."""
        whole = self.sizes
        begun = replace(whole, steps=max(1, whole.steps // 10), image_steps=max(1, whole.image_steps // 10))
        self.fits(f"{model}, begun", model, shards, begun, FIT_BEGUN)
        material = self.fits(model, model, shards, whole, FIT)
        if material is not None:
            self.material(model, material)

    def fits(self, name: str, model: str, shards: Path, sizes: Sizes, tolerance: float) -> Path | None:
        """Fits of equal steps; the folder of the reference's."""
        ways = {
            "the compiled kernel": (self.reference, {}),
            "PyTorch": (self.reference, NO_KERNEL),
            f"the device {self.device}": (self.device, NO_KERNEL),
        }
        if model == "hierarchical":
            # The kernel has no such model.
            del ways["the compiled kernel"]
        first, *others = ways
        fits = {}
        for way, (device, environment) in ways.items():
            out = self.folder / f"{name}, {way}"
            given = (device, model, sizes.text(), str(shards), str(out))
            found = self.measure(f"training {name}, by {way}", "train", *given, environment=environment)
            if found is not None:
                with np.load(out / PREDICTIONS) as arrays:
                    fits[way] = dict(arrays)
        for way in others:
            if first in fits and way in fits:
                named = f"error of {name}, by {way}, relative"
                self.checks.append(compare_fits(named, fits[first], fits[way], tolerance))
        return self.folder / f"{name}, {first}" if first in fits else None

    def material(self, model: str, folder: Path) -> None:
        """Conformance of a material that was fitted on the reference."""
        for number, device in enumerate((self.reference, self.device)):
            side = _side(number, device)
            ways: dict[str, tuple[str, float, tuple[str, ...]]] = {"PyTorch": ("infer", SINGLE, ())}
            if model != "hierarchical":
                # Plugin and shaders do not support its decoder.
                ways |= {name: ("evaluate_plugin", most, (name,)) for name, most in ARITHMETICS.items()}
                ways |= {
                    f"Slang, {name}": ("evaluate_slang", most, (name,)) for name, most in SHADERS.items()
                }
            for way, (function, most, more) in ways.items():
                name = f"{model} on {side}, {way}"
                given = (device, *more, self.sizes.text(), str(folder))
                found = self.measure(name, function, *given, environment=NO_KERNEL)
                if found is not None:
                    self.checks.append(Check(f"conformance of {name}", found["deviation"], most))
        if model == "hierarchical":
            return
        name = f"picture of {model}"
        pictures = self.both(name, "render", self.sizes.text(), str(folder))
        if pictures is not None:
            # The plugin's default on a GPU is half precision.
            self.checks.append(compare_mean(name, *pictures, HALF))
            self.checks.append(compare_values(f"{name}: pixels", *pictures))


def _side(number: int, device: str) -> str:
    return f"the {('reference', 'device')[number]} {device}"


def models(layout: str) -> list[str]:
    """Models that learn from a layout."""
    from mbtf_fit.models.registry import MODELS

    return [name for name, model in MODELS.items() if model.layout == layout]


def has_device() -> bool:
    """Whether PyTorch or Mitsuba finds a CUDA device. Where only one does, the other's steps fail."""
    import torch

    from mbtf_gen.engine.runtime import CUDA_VARIANT, prove

    return torch.cuda.is_available() or not prove(CUDA_VARIANT).fault


def in_child(function: str, arguments: tuple[str, ...], environment: Mapping[str, str]) -> ChildResult:
    """Run a measurement in a process of its own."""
    return run_child("gpu_measurements", function, *arguments, timeout=TIMEOUT, environment=environment)


def report(comparison: Comparison) -> int:
    """Print tables and the object of all results; the exit code."""
    for name, figures in comparison.figures.items():
        numbers = (
            f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}"
            for key, value in figures.items()
        )
        print(f"{name}: {', '.join(numbers)}")
    print()
    for check in comparison.checks:
        print(check.line())
    met = all(check.held for check in comparison.checks)
    checks = [{**asdict(check), "held": check.held} for check in comparison.checks]
    figures = {"device": comparison.device, "sizes": asdict(comparison.sizes), **comparison.figures}
    return finish({**figures, "checks": checks}, {"standard errors": STANDARD_ERRORS}, met)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--out", type=Path, help="folder to work in; a temporary one by default")
    parser.add_argument("--material", type=Path, default=ASSET, help="input of the generator")
    parser.add_argument("--resolution", type=int, default=Sizes.resolution, help="texels across")
    parser.add_argument("--steps", type=int, default=Sizes.steps, help="steps of each fit")
    options = parser.parse_args()
    if not has_device():
        print("no CUDA device: nothing to measure")
        return finish({"device": None}, {}, None)
    sizes = replace(
        Sizes(str(options.material)),
        resolution=options.resolution,
        steps=options.steps,
        image_steps=max(1, options.steps // 10),
    )
    with tempfile.TemporaryDirectory(prefix="mbtf-gpu-") as temporary:
        folder = options.out or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        comparison = Comparison(in_child, "cpu", "cuda", sizes, folder)
        comparison.all()
    return report(comparison)


if __name__ == "__main__":
    start(main)
