"""Whatever happens to a run or its files: one clear message, and the same command gives the same data set."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import RunPython
from support.datasets import edit
from support.file_operations import FileOperations, Operation
from support.paths import ROOT
from support.small_runs import command, contents, die, ending, generate, in_child, noisy_plane

from mbtf_core.data.documents import finished_record
from mbtf_core.data.folder import DataFolder
from mbtf_core.data.schema import Queries, ShardEntry
from mbtf_core.data.verify import verify
from mbtf_gen.planning.simulation import ClosedForm
from mbtf_gen.render.estimates import Estimates, Stream

# Between others, the files stay as they are: a kill leaves what one at the next of these does.
CHANGES = {"write", "pwrite", "ftruncate", "replace", "link", "unlink", "mkdir"}
ERRORS = (errno.EIO, errno.ENOSPC, errno.EACCES, errno.EMFILE)
PARTIAL_OR_INPUT = (3, 4)


@pytest.fixture(autouse=True)
def fast_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Values without a renderer, and no waiting for the disk: the system is not going to fail here."""
    monkeypatch.setattr(ClosedForm, "estimate", noisy_plane)
    monkeypatch.setattr(os, "fsync", lambda handle: None)


@pytest.fixture
def small(tmp_path: Path) -> Small:
    """A run of three shards, its folder not there yet."""
    return Small(tmp_path)


class Small:
    """A run of three shards.

    Attributes
    ----------
    line : command line; out : its folder; whole : folder of an undisturbed run; expected : its contents
    hash : of the configuration
    """

    def __init__(self, folder: Path) -> None:
        self.whole, self.out = folder / "whole", folder / "out"
        self.line = command(folder, self.out, train=60)
        assert generate(command(folder, self.whole, train=60)) == 0
        self.expected = contents(self.whole)
        self.hash = self.expected["manifest.json"]["config_hash"]

    def absent(self) -> None:
        shutil.rmtree(self.out, ignore_errors=True)

    def unmerged(self) -> None:
        """Every shard is there, the manifest does not say so."""
        self.absent()
        shutil.copytree(self.whole, self.out)
        edit(self.out / "manifest.json", lambda manifest: manifest.update(complete=False, summary=None))

    def corrupt(self) -> None:
        """A shard, a sidecar, the configuration, and what a kill leaves."""
        self.absent()
        shutil.copytree(self.whole, self.out)
        for name, at in (
            ("train-00000.npz", 900),
            ("test-00000.json", 300),
            ("config.yaml", 40),
            ("geometry.exr", 900),
        ):
            flip(self.out / name, at)
        (self.out / ".train-00001.lock").write_text("{}")
        (self.out / ".train-00001.json.0123abcd-9.tmp").write_text("{")

    def corrupt_manifest(self) -> None:
        """As before, and the manifest is corrupt."""
        self.corrupt()
        (self.out / "config.yaml").write_bytes((self.whole / "config.yaml").read_bytes())
        flip(self.out / "manifest.json", 2000)


def flip(path: Path, at: int, mask: int = 1) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= mask
    path.write_bytes(content)


def alike(operation: Operation) -> Operation:
    """What one operation has in common with those on other shards."""
    return operation[0], re.sub(r"(train|test)-\d+", "shard", operation[1]), operation[2]


def operations(line: list[str], small: Small, prepare: Callable[[], None], thorough: bool) -> list[Operation]:
    """What a command does below the folder; where not `thorough`, one of each sort."""
    prepare()
    with FileOperations(small.out) as watch:
        assert generate(line) == 0
    assert contents(small.out) == small.expected
    assert len(set(watch.seen)) == len(watch.seen) > 20
    if thorough:
        return watch.seen
    # The last of a sort comes after others of its kind are finished.
    return list({alike(operation): operation for operation in watch.seen}.values())


COMMANDS = {
    "run": (Small.absent, lambda s: s.line),
    "merge": (Small.unmerged, lambda s: ["merge", str(s.out)]),
    "repair": (Small.corrupt, lambda s: ["repair", str(s.out), "-q"]),
    "repair of the manifest": (Small.corrupt_manifest, lambda s: ["repair", str(s.out), "-q"]),
    "overwrite": (Small.unmerged, lambda s: [*s.line, "--overwrite"]),
}
# The normal suite tries a sample of the commands that write most, the slow one everything.
thoroughly = pytest.mark.parametrize(
    ("name", "thorough"),
    [
        *((name, False) for name in ("run", "merge", "repair")),
        *(pytest.param(name, True, marks=pytest.mark.slow) for name in COMMANDS),
    ],
)


@thoroughly
def test_any_file_operation_may_fail(
    name: str, thorough: bool, small: Small, capsys: pytest.CaptureFixture[str]
) -> None:
    prepare, line_of = COMMANDS[name]
    line = line_of(small)
    refused = 0
    found = operations(line, small, lambda: prepare(small), thorough)
    for index, operation in enumerate(found if thorough else found[::4]):
        for number in ERRORS if thorough else (ERRORS[index % len(ERRORS)],):
            prepare(small)
            capsys.readouterr()

            def fail(now: Operation, at: Operation = operation, number: int = number) -> None:
                if now == at:
                    raise OSError(number, os.strerror(number), str(small.out / now[1]))

            with FileOperations(small.out, fail) as watch:
                code = generate(line)
            captured = capsys.readouterr()
            errors = [x for x in captured.err.splitlines() if not x.startswith("warning: ")]
            where = f"{operation} {errno.errorcode[number]}: {code} {errors}"
            assert operation in watch.seen
            if code == 4 and not errors:
                assert "unfinished" in captured.out, where
            elif code:
                refused += 1
                assert code in PARTIAL_OR_INPUT, where
                assert 1 <= len(errors) <= 2, where
                assert errors[0].startswith(f"error: {small.out}"), where
            else:
                # It did not matter, as for a lock that stays behind.
                assert errors == [], where
            assert generate(line) == 0, where
            assert contents(small.out) == small.expected, where
    assert refused > 3


@thoroughly
def test_a_kill_at_any_file_operation_loses_nothing(name: str, thorough: bool, small: Small) -> None:
    prepare, line_of = COMMANDS[name]
    line = line_of(small)
    killed = 0
    for operation in operations(line, small, lambda: prepare(small), thorough):
        if operation[0] not in CHANGES:
            continue
        prepare(small)

        def kill(now: Operation, at: Operation = operation) -> None:
            if now == at:
                die()

        def act(kill: Callable[[Operation], None] = kill) -> int:
            with FileOperations(small.out, kill):
                return generate(line)

        assert ending(in_child(act)) == -signal.SIGKILL, operation
        killed += 1
        assert generate(line) == 0, operation
        assert contents(small.out) == small.expected, operation
    assert killed > 3


def test_a_sidecar_is_removed_before_its_shard_is_replaced(small: Small) -> None:
    """The shard is gone, its sidecar not: it goes before another shard takes the name."""
    repaired, kept = ["repair", str(small.out), "-q"], small.line
    for prepare, line, stems in ((small.corrupt, repaired, (0, 1)), (small.unmerged, kept, (1,))):
        prepare()
        (small.out / "train-00001.npz").unlink()
        with FileOperations(small.out) as watch:
            assert generate(line) == 0
        for stem in (f"train-0000{number}" for number in stems):
            order = [
                watch.seen.index(("unlink", f"{stem}.json", 1)),
                watch.seen.index(("replace", f".{stem}.npz.tmp", 1)),
                watch.seen.index(("replace", f".{stem}.json.tmp", 1)),
            ]
            assert order == sorted(order)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("name", ["run", "repair"])
def test_an_interrupted_run_keeps_its_shards(
    name: str,
    number: signal.Signals,
    small: Small,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    prepare, line_of = COMMANDS[name]
    prepare(small)
    line, rendered = line_of(small), 0

    def interrupted(
        self: ClosedForm, queries: Queries, spp: int, stream: Stream, *, lights: int = 1
    ) -> Estimates:
        nonlocal rendered
        if rendered == 1:
            os.kill(os.getpid(), number)
        rendered += 1
        return noisy_plane(self, queries, spp, stream)

    capsys.readouterr()
    with monkeypatch.context() as patch:
        patch.setattr(ClosedForm, "estimate", interrupted)
        assert generate(line) == 130
    errors = [x for x in capsys.readouterr().err.splitlines() if not x.startswith("warning: ")]
    assert len(errors) == 2
    assert errors[0].startswith("error: interrupted; ")
    assert "is kept" in errors[0] or "are kept" in errors[0]
    assert errors[1] == "  the same command resumes"
    # The shard that was rendered, and no other one of those to make.
    assert rendered == 1
    shards = [ShardEntry("train", 0, "train-00000.npz", 40), ShardEntry("test", 0, "test-00000.npz", 30)]
    assert [bool(finished_record(DataFolder.open(small.out), shard, small.hash)) for shard in shards] == [
        True,
        False,
    ]
    assert (small.out / "train-00000.npz").read_bytes() == small.expected["train-00000.npz"]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert generate(line) == 0
    assert contents(small.out) == small.expected


def test_two_runs_at_once_make_every_shard_once(tmp_path: Path) -> None:
    assert generate(command(tmp_path, tmp_path / "whole", train=600)) == 0
    line = command(tmp_path, tmp_path / "out", train=600)
    children = [in_child(lambda: generate(line)) for _ in range(3)]
    # A shard that another one still writes at the end is left to it; the last one finishes the data set.
    endings = {ending(child) for child in children}
    assert {0} <= endings <= {0, 4}
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


# Runs the program on a file system of 60 kB, gives it more room, and runs it again.
FULL = """
set -e
mount -t tmpfs -o size=60k none full
status=0
"$@" 2> errors || status=$?
mount -o remount,size=10m full
"$@" 2> errors_again
cp -r full/out out
echo $status
"""


@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare: no file system to fill")
@pytest.mark.parametrize("suffix", ["npz", "exr"])
def test_a_full_disk_ends_in_one_message_and_more_room_repairs_it(suffix: str, tmp_path: Path) -> None:
    spaces = ["unshare", "--user", "--map-root-user", "--mount"]
    (tmp_path / "full").mkdir()
    probe = subprocess.run([*spaces, "mount", "-t", "tmpfs", "none", tmp_path / "full"], capture_output=True)
    if probe.returncode:
        pytest.skip("no file system can be mounted here")
    # The noise of the fixtures does not reach another program: values of a plane, all alike.
    # The disk has room when the run starts.
    start = "import sys; from mbtf_core.files import folders; folders.check_space = lambda *a: None; "
    start += "from mbtf_gen.__main__ import main; sys.exit(main())"
    program = [sys.executable, "-c", start, *command(tmp_path, tmp_path / "full/out", train=1500)]
    program += ["--format", suffix]
    done = subprocess.run(
        [*spaces, "sh", "-c", FULL, "sh", *program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == "4"
    errors = [x for x in (tmp_path / "errors").read_text().splitlines() if not x.startswith("warning: ")]
    assert len(errors) == 2, errors
    assert "No space left on device" in errors[0]
    assert verify(tmp_path / "out") == []
    assert not list((tmp_path / "out").glob(".*"))


@pytest.mark.slow
def test_random_kills_lose_nothing_and_corruption_is_found(run_python: RunPython) -> None:
    amounts = "--kills 150 --flips 3000 --repairs 60 --rendered 6"
    done = run_python(str(ROOT / "benchmarks/crash_safety.py"), *amounts.split())
    assert done.returncode == 0, done.stdout + done.stderr
    figures = json.loads(done.stdout.splitlines()[-1])["figures"]
    assert figures["lost or not found"] == 0
    assert figures["killed"]["kills"] >= 3
    assert figures["killed"]["data sets"] > 0
    assert figures["damaged"]["cuts"] > 0
