"""``mbtf-fit preview`` in a process that can import neither PyTorch nor reach a network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from conftest import RunPython
from PIL import Image
from support.command_lines import call, fails
from support.plugin_materials import write_material

BLOCKED = """
import socket, sys
for name in ("torch", "scipy", "trimesh", "pyvista"):
    sys.modules[name] = None  # importing it fails
def refuse(*a, **k):
    raise AssertionError("the network was asked for")
socket.socket.connect = refuse
from mbtf_fit.__main__ import main
sys.argv = ["mbtf-fit", *sys.argv[1:]]
sys.exit(main())
"""
SIZES = "--size 64 --turn-size 16 --frames 2 --spp 1"
SMALL = (*SIZES.split(), "--set", "sheet.tiles_across=[1, 3]")


def test_pictures_without_pytorch_kept_and_refused(tmp_path: Path, run_python: RunPython) -> None:
    write_material(tmp_path / "material", finest=1)
    words = ("preview", str(tmp_path / "material"), "-o", str(tmp_path / "out"))
    done = run_python("-c", BLOCKED, *words, *SMALL, "--json")
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    assert [Path(p["file"]).name for p in report["pictures"]] == ["sheet.png", "turntable.gif"]
    assert not any(p["kept"] for p in report["pictures"])
    with Image.open(tmp_path / "out/turntable.gif") as turn:
        assert (turn.size, turn.n_frames) == ((16, 16), 2)
    with Image.open(tmp_path / "out/sheet.png") as sheet:
        assert sheet.width > 6 * 64
    (tmp_path / "out/turntable.gif").unlink()

    def again(*options: str) -> dict[str, Any]:
        return call(["mbtf-fit", *words, *SMALL, *options, "--json"]).result()

    assert [p["kept"] for p in again()["pictures"]] == [True, False]
    shown = [again("--exposure", "1") for _ in range(2)]
    assert [p["kept"] for p in shown[0]["pictures"] + shown[1]["pictures"]] == [False, False, True, True]
    assert (shown[0]["exposure"], shown[1]["exposure"]) == (1.0, 1.0) != (report["exposure"],) * 2
    record = json.loads((tmp_path / "out/pictures.json").read_text())
    assert [p["facts"]["exposure"] for p in record["items"].values()] == [1.0, 1.0]
    only = ("--sheet-only", "--view", "60,-90", "--light", "45,45", "-o", str(tmp_path / "sheet"))
    sheet = call(["mbtf-fit", *words[:2], *SMALL, *only, "--json"]).result()
    assert [Path(p["file"]).name for p in sheet["pictures"]] == ["sheet.png"]
    with Image.open(tmp_path / "sheet/sheet.png") as picture:
        assert picture.width < 2 * 64
    message = fails(3, *words, *SMALL, "--tiles-around", "5")
    assert "another configuration: turntable.tiles: unset -> 5" in message
