"""Facts that manifests and sidecars share."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import MANIFEST_NAME
from mbtf_core.data.sidecar import repair_hint
from mbtf_core.files.digest import data_sha256

CHECK_HINT = "check the data set with: mbtf-gen verify"


def software_versions() -> dict[str, str]:
    """Versions of the software that the values depend on."""
    out = {"python": platform.python_version(), "machine": platform.machine()}
    for name in ("mbtf", "mitsuba", "drjit", "numpy", "trimesh"):
        try:
            out[name] = version(name)
        except PackageNotFoundError:
            out[name] = "not installed"
    return out


def plan_digest(manifest: Mapping[str, Any]) -> str:
    """SHA-256 of what the run plan in a manifest decides, hexadecimal. The sidecars of all shards repeat it.

    Explanations and bias bounds are left out: they decide nothing, and other versions word them differently.
    """
    # Measured data have no plan.
    plan = manifest.get("effects") or {}
    decided = {key: plan.get(key) for key in ("max_depth", "roulette_depth", "closed_form")}
    on = sorted(effect["name"] for effect in plan.get("effects", []) if effect["on"])
    return data_sha256({**decided, "effects": on, "allocation": manifest.get("allocation")})


def read_manifest(folder: str | Path | DataFolder) -> dict[str, Any]:
    """The manifest of a folder; an InputError unless it is exactly as it was written."""
    found = folder if isinstance(folder, DataFolder) else DataFolder.open(folder)
    return found.read_checksummed(MANIFEST_NAME, repair_hint(found))
