"""Completion in the shell: commands, options, choices and files."""

from __future__ import annotations

import os
import pty
import select
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from cyclopts import App

from mbtf_core.app.console import run
from mbtf_fit.cli.app import app as fit
from mbtf_gen.cli.app import app as generate
from mbtf_pipeline.cli.app import app as pipeline

# Readline's part of `-o default`: file names where the script has nothing to offer.
_COMPLETE = """
source {script}
COMP_WORDS=({line}) COMP_CWORD={last}
$(complete -p {program} | sed 's/.* -F \\([^ ]*\\) .*/\\1/')
[ ${{#COMPREPLY[@]}} -gt 0 ] || complete -p {program} | grep -q -- '-o default' &&
  COMPREPLY+=($(compgen -f -- {word}))
printf '%s\\n' "${{COMPREPLY[@]}}"
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def offered(script: Path, line: str) -> set[str]:
    """What bash offers for the last word of a line."""
    words = line.split(" ")
    code = _COMPLETE.format(
        script=shlex.quote(str(script)),
        line=" ".join(shlex.quote(w) for w in words),
        last=len(words) - 1,
        program=words[0],
        word=shlex.quote(words[-1]),
    )
    done = subprocess.run(["bash", "--norc", "-c", code], capture_output=True, text=True, cwd=script.parent)
    assert done.stderr == ""
    return set(done.stdout.split())


@pytest.mark.parametrize(
    ("app", "line", "wanted", "unwanted"),
    [
        (generate, "mbtf-gen ", "inspect plan verify selftest", "--spp draft"),
        (generate, "mbtf-gen d", "doctor", "plan"),
        (generate, "mbtf-gen mb", "mbtf-gen", "merge"),
        (generate, "mbtf-gen a.exr --quality ", "draft standard", "--spp"),
        (generate, "mbtf-gen inspect mb", "mbtf-gen", "doctor"),
        (generate, "mbtf-gen plan a.exr --sp", "--spp", "--slice"),
        (fit, "mbtf-fit ", "evaluate export", "doctor"),
        (fit, "mbtf-fit --model neu", "neumip neumip-baseline", "hierarchical"),
        (fit, "mbtf-fit set --ti", "--time", "--seed"),
        (fit, "mbtf-fit mb", "mbtf-fit", ""),
        (pipeline, "mbtf-pipeline ", "run cost list report", "doctor"),
        (pipeline, "mbtf-pipeline run --q", "--quality --quick --quiet", "--force"),
        (pipeline, "mbtf-pipeline run mb", "mbtf-pipeline", "report"),
    ],
)
def test_bash_completes(app: App, line: str, wanted: str, unwanted: str, home: Path) -> None:
    assert run(app, ["--install-completion", "--shell", "bash"]) == 0
    (script,) = home.glob(".local/**/mbtf-*")
    assert str(script) in (home / ".bashrc").read_text()
    found = offered(script, line)
    assert set(wanted.split()) <= found
    assert not set(unwanted.split()) & found


@pytest.mark.skipif(shutil.which("fish") is None, reason="needs fish")
@pytest.mark.parametrize(
    ("app", "line", "wanted", "unwanted"),
    [
        (generate, "mbtf-gen pl", "plan", "inspect"),
        (generate, "mbtf-gen a.exr --sp", "--spp", "--slice"),
        (generate, "mbtf-gen a.exr --quality ", "draft standard", "a.exr"),
        (generate, "mbtf-gen verify --qu", "--quiet", "--quality"),
        (fit, "mbtf-fit shards --model neu", "neumip neumip-baseline", "hierarchical"),
        (pipeline, "mbtf-pipeline run --q", "--quality --quick --quiet", "--force"),
    ],
)
def test_fish_completes(app: App, line: str, wanted: str, unwanted: str, home: Path) -> None:
    assert run(app, ["--install-completion", "--shell", "fish"]) == 0
    (home / "a.exr").touch()
    # Fish completes only what it could run.
    code = f"function {app.name[0]}; end; complete -C {shlex.quote(line)}"
    environment = {**os.environ, "XDG_CONFIG_HOME": str(home / ".config")}
    done = subprocess.run(["fish", "-c", code], capture_output=True, text=True, cwd=home, env=environment)
    assert done.stderr == ""
    found = {offer.split("\t")[0] for offer in done.stdout.splitlines()}
    assert set(wanted.split()) <= found
    assert not set(unwanted.split()) & found


@pytest.mark.skipif(shutil.which("zsh") is None, reason="needs zsh")
@pytest.mark.parametrize(
    ("app", "line", "completed"),
    [
        (generate, "mbtf-gen pl", "plan"),
        (generate, "mbtf-gen a.exr --sp", "a.exr --spp"),
        (fit, "mbtf-fit shards --quality d", "shards --quality draft"),
        (pipeline, "mbtf-pipeline run --qual", "run --quality"),
    ],
)
def test_zsh_completes(app: App, line: str, completed: str, home: Path) -> None:
    """In a new user's shell, which has no completion of its own."""
    startup = home / ".zshrc"
    startup.write_text(f'PROMPT=READY\n{app.name[0]}() print -r -- "<$*>"\n')
    for _ in range(2):
        assert run(app, ["--install-completion", "--shell", "zsh"]) == 0
    assert startup.read_text().count("compinit &&") == 1
    shell, terminal = pty.openpty()
    environment = {**os.environ, "ZDOTDIR": str(home), "TERM": "dumb"}
    process = subprocess.Popen(
        ["zsh", "-i"], stdin=terminal, stdout=terminal, stderr=terminal, cwd=home, env=environment
    )
    try:
        shown = b""
        for awaited, typed in (
            (b"READY", f"{line}\t".encode()),
            (b"", b"\n"),
            (f"<{completed}>".encode(), b""),
        ):
            while awaited not in shown:
                assert select.select([shell], [], [], 10)[0], shown
                shown += os.read(shell, 1 << 16)
            os.write(shell, typed)
    finally:
        process.kill()
        process.wait()
        os.close(shell)
        os.close(terminal)


def test_zsh_completes_the_material_as_a_file() -> None:
    assert (
        "'1:Height map, folder of maps, material.yaml, mesh, or file of yarns or fibers.:_files'"
        in generate.generate_completion(shell="zsh")
    )


def test_an_unknown_shell_is_a_usage_error(
    home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("SHELL", "PATH", "BASH_VERSION", "ZSH_VERSION", "FISH_VERSION"):
        monkeypatch.setenv(name, "")
    assert run(generate, ["--install-completion"]) == 2
    assert "--install-completion --shell bash" in capsys.readouterr().err
    assert list(home.iterdir()) == []
