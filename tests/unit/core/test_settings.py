"""Configuration: file, then assignments, then flags; faults are named with key, line and hint."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import pytest
from pydantic import Field

from mbtf_core.config.settings import Settings, resolve
from mbtf_core.config.yaml_file import dump_yaml
from mbtf_core.errors import InputError, UsageError


class Light(Settings):
    width_deg: float = Field(1.0, ge=0, le=30)
    kind: Literal["lobe", "delta"] = "lobe"


class Stage(Settings):
    name: str
    spp: int = Field(16, gt=0)


class Whole(Settings):
    exclusive = (("levels", "stages"),)

    height: float = 1.0
    light: Light = Light()
    levels: int | None = None
    stages: tuple[Stage, ...] = ()


@pytest.fixture
def write(tmp_path: Path) -> Any:
    def write(text: str) -> Path:
        path = tmp_path / "config.yaml"
        path.write_text(text)
        return path

    return write


def test_assignments_are_read_as_yaml_and_later_ones_win() -> None:
    assignments = ["stages=[{name: a, spp: 4}]", "levels=null", "height=1e-6"]
    assignments += ["light.width_deg=5", "light.width_deg=6", "light.kind=delta"]
    whole = resolve(Whole, assignments=assignments)
    assert whole.light == Light(width_deg=6, kind="delta")
    assert whole.stages == (Stage(name="a", spp=4),)
    assert whole.levels is None
    assert whole.height == 1e-6


@pytest.mark.parametrize(
    ("text", "where", "what", "hint"),
    [
        ("width_deg: 2\n", 1, "unknown key 'width_deg'", "did you mean 'light.width_deg'?"),
        ("light:\n  levels: 2\n", 2, "unknown key 'light.levels'", "did you mean 'levels'?"),
        ("stages:\n- name: a\n- name: b\n  ssp: 2\n", 4, "unknown key 'stages.1.ssp'", "did you mean 'spp'?"),
        ("light:\n  width_deg: 31\n", 2, "'light.width_deg': must be less than or equal to 30", ""),
        ("stages:\n- spp: 2\n", 2, "key 'stages.0.name' is missing", "add it"),
        ("height: .inf\n", 1, "'height': must be a finite number (given inf)", ""),
        (
            "stages: [{name: a}]\nlevels: 2\n",
            2,
            "'levels' and 'stages' are mutually exclusive",
            "give one of them",
        ),
    ],
)
def test_faults_name_line_and_hint(write: Any, text: str, where: int, what: str, hint: str) -> None:
    path = write(text)
    with pytest.raises(InputError) as caught:
        resolve(Whole, file=path)
    assert caught.value.where == f"{path}:{where}"
    assert caught.value.what.startswith(what)
    assert caught.value.hint == hint


def test_what_is_dumped_reads_back(tmp_path: Path) -> None:
    whole = Whole(height=1e-6, light=Light(kind="delta"), stages=(Stage(name="ä: #"),))
    path = tmp_path / "resolved.yaml"
    path.write_text(dump_yaml(whole.model_dump(mode="json")), encoding="utf-8")
    assert resolve(Whole, file=path) == whole
    assert path.read_text(encoding="utf-8").startswith("height:")


def test_a_value_that_a_flag_gave_is_blamed_on_the_flag(write: Any) -> None:
    spelled = {"light.width_deg": "--width"}
    with pytest.raises(UsageError) as caught:
        resolve(Whole, flags={"light.width_deg": 31}, spelled=spelled)
    assert caught.value.message == "--width: 'light.width_deg': must be less than or equal to 30 (given 31)"
    # Another source of the same key is not the flag.
    with pytest.raises(UsageError) as caught:
        resolve(Whole, assignments=["light.width_deg=31"], spelled=spelled)
    assert caught.value.where == "command line"
    with pytest.raises(InputError) as read:
        resolve(Whole, file=write("light: {width_deg: 31}\n"), spelled=spelled)
    assert str(read.value.where).endswith("config.yaml:1")
