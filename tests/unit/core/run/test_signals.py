"""Signals at any instant of a program: its exit code, one message, no lock that remains."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from mbtf_core.run import signals
from mbtf_core.run.signals import stop_on_interruption

# What the stand-ins of libraries and commands below begin with: signals of this process, and an attempt to
# go on for longer than the test takes.
SEND = """
import ctypes, os, signal, sys, time
def send():
    os.kill(os.getpid(), int(os.environ["TEST_SIGNAL"]))
    for _ in range(2000):
        time.sleep(0.01)
"""
IMPORTS = {
    "raises": "send()",
    "converts": "try: send()\nexcept BaseException: raise ImportError('no symbol') from None",
    "swallows": "try: send()\nexcept BaseException: pass",
}
# Bodies of a command that also holds a lock.
COMMANDS = {
    "raised": "send()",
    "converted": "try: send()\n    except BaseException: raise RuntimeError('callback failed') from None",
    "swallowed": "try: send()\n    except BaseException: time.sleep(20)",
    "swallowed until the end": "try: send()\n    except BaseException: pass",
    "native code": "send_later()\n    ctypes.CDLL(None).usleep(20_000_000)",
    "a pool": "from concurrent.futures import ThreadPoolExecutor\n"
    "    with ThreadPoolExecutor(1) as pool: pool.submit(time.sleep, 20); send()",
}
PROGRAM = """
import threading
from pathlib import Path
from mbtf_core.run import signals
signals._NOTE_SECONDS = signals._GRACE_SECONDS = 0.2
signals.handle_signals()
from mbtf_core.app.console import new_app, run
from mbtf_core.files.folders import owned
app = new_app("prog", "A program.")
def send_later():
    threading.Timer(0.2, os.kill, (os.getpid(), int(os.environ["TEST_SIGNAL"]))).start()
@app.default
def command():
  signals.keep_on_interruption("two shards are kept")
  with owned(Path("out")):
    Path("out/file").touch()
    BODY
sys.exit(signals.finish(run(app, [])))
"""


def run_program(
    number: signal.Signals, folder: Path, *arguments: str, **variables: str
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "TEST_SIGNAL": str(int(number)), **variables},
        capture_output=True,
        text=True,
        timeout=15,
        check=False,
    )


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize(
    ("program", "library"),
    [
        *(("mbtf_gen", "raises"), ("mbtf_pipeline", "raises")),
        *(("mbtf_fit", library) for library in IMPORTS),
    ],
)
def test_a_signal_while_a_library_loads(
    program: str, library: str, number: signal.Signals, tmp_path: Path
) -> None:
    (tmp_path / "cyclopts.py").write_text(SEND + IMPORTS[library])
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = run_program(number, tmp_path, "-m", program, "--version", PYTHONPATH=path)
    assert done.returncode == 130, done.stderr
    assert done.stderr == "error: interrupted\n  run the same command again\n"
    assert done.stdout == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_signal_while_a_command_works(command: str, number: signal.Signals, tmp_path: Path) -> None:
    code = SEND + PROGRAM.replace("BODY", COMMANDS[command])
    done = run_program(number, tmp_path, "-c", code)
    assert done.returncode == 130, done.stderr
    assert done.stderr.endswith("error: interrupted; two shards are kept\n  the same command resumes\n")
    assert "Traceback" not in done.stderr
    # The file of a lock may stay where the process ends at once; the lock itself does not.
    assert [path.name for path in (tmp_path / "out").glob("[!.]*")] == ["file"]


# What a command may leave to the end of the interpreter, and what it may not: objects of modules would be
# removed after the default actions of signals are restored.
ENDING = """
import atexit, tempfile, threading, weakref
import mbtf_core.run.signals as i
i.handle_signals()
number = int(os.environ["TEST_SIGNAL"])
class Late:
    def __del__(self, write=os.write, kill=os.kill, me=os.getpid()):
        write(1, b"unloaded\\n")
        kill(me, number)
late = Late()
folder = tempfile.TemporaryDirectory(dir=".")
atexit.register(print, "exit function")
threading.Timer(0.2, print, ["thread"]).start()
print("command")
sys.exit(i.finish(4))
"""


@pytest.mark.parametrize("number", signals.SIGNALS)
def test_a_program_ends_without_unloading(number: signal.Signals, tmp_path: Path) -> None:
    done = run_program(number, tmp_path, "-c", f"import os, sys\n{ENDING}")
    assert (done.returncode, done.stdout, done.stderr) == (4, "command\nthread\nexit function\n", "")
    assert list(tmp_path.iterdir()) == []


def test_a_reader_that_has_gone_is_no_error(tmp_path: Path) -> None:
    code = "import sys\nimport mbtf_core.run.signals as i\ni.handle_signals()\n"
    code += "print('late')\nsys.exit(i.finish(4))"
    reader, writer = os.pipe()
    os.close(reader)
    buffered = {**os.environ, "PYTHONUNBUFFERED": ""}
    done = subprocess.run(
        [sys.executable, "-c", code],
        stdout=writer,
        stderr=subprocess.PIPE,
        env=buffered,
        timeout=15,
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (4, b"")


def test_work_stops_at_a_step_and_then_as_usual(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signals._State, "received", None)
    with stop_on_interruption() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        # The echo of a wrapper.
        signal.raise_signal(signal.SIGINT)
        monkeypatch.setattr(signals, "_ECHO_SECONDS", 0.0)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_signal_after_the_last_act_changes_nothing(tmp_path: Path) -> None:
    code = f"{SEND}\nfrom mbtf_core.run.signals import *\nhandle_signals()\ncode = finish(4)\nsend()"
    assert run_program(signal.SIGTERM, tmp_path, "-c", code).returncode == 4
