"""Validations in words: of a running fit, and whether and why a fit ended early."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from mbtf_core.units import clock
from mbtf_fit.config import FitConfig
from mbtf_fit.formatting import format_estimate

# Share of the training time up to which a shorter one is suggested.
_SHORTER = 0.75


def describe_validations(records: Sequence[dict[str, Any]]) -> str:
    """One line for the progress bar, from the last validation of each material."""
    first = records[0]
    text = f"loss {first['loss']:.3f}"
    known = [r["unexplained"] for r in records if r["unexplained"] is not None]
    if len(records) > 1 and known:
        text += f", validation error {min(known):.3f} to {max(known):.3f}"
    elif known:
        estimate = {"value": first["unexplained"], "error": first["unexplained_error"]}
        text += f", validation error {format_estimate(estimate)}"
    return f"{text}, {first['queries_per_second'] / 1e6:.2f} M queries/s"


def reached(config: FitConfig, history: Sequence[dict[str, Any]]) -> bool | None:
    """Whether the last validation, with its standard error, is at or below the error of the configuration;
    None if it has none."""
    if config.training.error is None:
        return None
    value, error = (history[-1].get(key) if history else None for key in ("unexplained", "unexplained_error"))
    return value is not None and error is not None and value + error <= config.training.error


def kept_step(training: Mapping[str, Any]) -> int | None:
    """Step of the state that a fit has kept, from the record of its training, if it is not the last: later,
    the fit overfitted. The history of materials that share a network counts the steps of all."""
    counted = training.get("shared_decoder") or training
    kept: int | None = counted.get("kept_step")
    return None if kept == counted.get("steps") else kept


def describe_kept(history: Sequence[dict[str, Any]], kept: int | None) -> str | None:
    """That a fit returned to the state of a step, in one line; None if it kept the last."""
    best = next((r for r in history if r["step"] == kept), None)
    if best is None:
        return None
    last = history[-1]
    first, then = best["unexplained"], last["unexplained"]
    text = f"kept the state after {kept} steps"
    # Few test queries may leave the errors undefined, though not their change.
    if first is None or then is None:
        text = f"validation error rose between steps {kept} and {last['step']}: {text}"
    else:
        rise = f"rose from {first:.2g} after {kept} steps to {then:.2g} after {last['step']}"
        text = f"validation error {rise}: {text}"
    share = math.ceil(20.0 * best["step"] / last["step"]) / 20.0
    return f"{text}; {share:.0%} of the time suffices" if share <= _SHORTER else text


def describe_ending(config: FitConfig, history: Sequence[dict[str, Any]]) -> str | None:
    """Why training ended, in one line; None if it had no error to reach."""
    found = reached(config, history)
    if found is None or not history:
        return None
    last, training = history[-1], config.training
    error = format_estimate({"value": last["unexplained"], "error": last["unexplained_error"]})
    steps, time = training.steps, training.time
    # The fewest steps of a time took longer.
    if steps is None and last["seconds"] > time.seconds and last["step"] <= time.min_steps:
        steps = time.min_steps
    limit = clock(time.seconds) if steps is None else f"{steps} steps"
    if found:
        spent = clock(last["seconds"]) if steps is None else str(last["step"])
        return f"stopped at error {training.error:g} after {spent} of {limit}: validation error {error}"
    return f"stopped after {limit}: validation error {error} has not reached {training.error:g}"
