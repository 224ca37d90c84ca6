"""Stand-ins for SLURM, Kubernetes and the programs, which run emitted jobs at once and one after another.

:func:`install` makes the commands; each runs this file with its own name.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

PROGRAMS = ("mbtf-gen", "mbtf-fit", "mbtf-pipeline")
SCHEDULERS = ("sbatch", "scontrol", "kubectl")
# Variable with the folder of the state.
_STATE = "FAKE_CLUSTER"


def install(folder: Path, names: tuple[str, ...] = (*PROGRAMS, *SCHEDULERS)) -> dict[str, str]:
    """Make commands in a folder; returns the environment that finds them."""
    folder.mkdir()
    for name in names:
        # Without installed packages, Python starts sooner.
        options = [] if name == "kubectl" else ["-S", "-E"]
        command = shlex.join([sys.executable, *options, __file__, name])
        (folder / name).write_text(f'#!/bin/sh\nexec {command} "$@"\n')
        (folder / name).chmod(0o755)
    return {**clean_environment(folder), _STATE: str(folder)}


def clean_environment(folder: Path) -> dict[str, str]:
    """The environment without that of a scheduler or of make, and with a folder of programs."""
    foreign = ("SLURM", "SBATCH", "MAKE", "MFLAGS")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(foreign)}
    return {**kept, "PATH": f"{folder}:{os.environ['PATH']}"}


def calls(folder: Path) -> list[dict[str, Any]]:
    """Calls of the programs so far: their words, folder, exit code."""
    path = folder / "calls"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def fail(folder: Path, text: str, codes: list[int]) -> None:
    """Let the next commands that contain a text exit with these codes, then with 0; those that start jobs do
    nothing then."""
    (folder / "failures.json").write_text(json.dumps({"text": text, "codes": codes}))


def _state(name: str) -> Path:
    return Path(os.environ[_STATE]) / name


def _planted(words: list[str]) -> int:
    """Exit code of a command by :func:`fail`; 0 if it is none of these."""
    code, plan = 0, _state("failures.json")
    if plan.exists():
        failures = json.loads(plan.read_text())
        if failures["text"] in " ".join(words) and failures["codes"]:
            code = failures["codes"].pop(0)
            plan.write_text(json.dumps(failures))
    if code:
        print("error: planted", file=sys.stderr)
    return code


def _program(words: list[str]) -> int:
    code = _planted(words)
    with _state("calls").open("a") as stream:
        stream.write(json.dumps({"words": words, "cwd": os.getcwd(), "code": code}) + "\n")
    return code


def _flags(words: list[str]) -> tuple[dict[str, str], list[str]]:
    """Long options, and the rest."""
    options = dict(w.removeprefix("--").partition("=")[::2] for w in words if w.startswith("--"))
    return options, [w for w in words if not w.startswith("--")]


def _sbatch(words: list[str]) -> int:
    options, (script,) = _flags(words)
    path = Path(script)
    stated = re.findall(r"^#SBATCH (.*)$", path.read_text(), re.MULTILINE)
    options = _flags(shlex.split(" ".join(stated)))[0] | options
    number = str(len(list(_state("").glob("job-*"))) + 1)
    job = _state(f"job-{number}")
    needs = options.get("dependency", "").removeprefix("afterok:").split(":")
    # Without it, they would wait for ever for a job that has failed.
    assert options.get("kill-on-invalid-dep") == "yes" or "dependency" not in options
    results = {}
    if all(_state(f"job-{need}").read_text() == "done" for need in filter(None, needs)):
        first, _, last = options.get("array", "").partition("-")
        for task in range(int(first), int(last) + 1) if first else [None]:
            results[task] = _run_task(path, number, task, options)
    state = "failed" if any(results.values()) else "done"
    job.write_text(state if results else "cancelled")
    print(number)
    return 0


def _run_task(script: Path, number: str, task: int | None, options: dict[str, str]) -> int:
    log = options["output"].replace("%A", number).replace("%j", number).replace("%a", str(task))
    environment = {**os.environ, "SLURM_JOB_ID": number, "SLURM_JOB_NAME": options["job-name"]}
    own = number
    if task is not None:
        own = f"{number}_{task}"
        environment |= {"SLURM_ARRAY_JOB_ID": number, "SLURM_ARRAY_TASK_ID": str(task)}
    restarts = 0
    while True:
        environment["SLURM_RESTART_COUNT"] = str(restarts)
        with Path(log).open("a" if options.get("open-mode") == "append" else "w") as stream:
            done = subprocess.run(
                ["bash", str(script)], stdout=stream, stderr=stream, env=environment, check=False
            )
        queued = _state(f"requeue-{own}")
        if not queued.exists():
            return done.returncode
        queued.unlink()
        restarts += 1


def _scontrol(words: list[str]) -> int:
    assert words[0] == "requeue"
    _state(f"requeue-{words[1]}").touch()
    return 0


def read_job(path: Path) -> dict[str, Any]:
    """An object of Kubernetes."""
    from ruamel.yaml import YAML

    found = YAML(typ="safe", pure=True).load(path)
    assert isinstance(found, dict)
    return found


def _kubectl(words: list[str]) -> int:
    words = [w for w in words if w not in ("--ignore-not-found", "--namespace=test")]
    status = _state("kubernetes.json")
    jobs = json.loads(status.read_text()) if status.exists() else {}
    if words[0] == "apply":
        job = read_job(Path(words[2]))
        name = job["metadata"]["name"]
        if name not in jobs:
            jobs[name] = _run_pods(job["spec"])
    elif words[0] == "delete":
        del jobs[words[1].removeprefix("job/")]
    elif words[0] == "get":
        name = words[1].removeprefix("job/")
        asked = re.search(r'@\.type=="(\w+)"', " ".join(words))
        if asked is not None:
            print("True" if jobs.get(name) == asked[1] else "", end="")
        elif name not in jobs:
            return 1
    else:
        return 1
    status.write_text(json.dumps(jobs))
    return 0


def expanded(text: str) -> str:
    """What Kubernetes makes of a command's word; no variable is defined."""
    return re.sub(r"\$\$", "$", text)


def _run_pods(spec: dict[str, Any]) -> str:
    """Run the pods of a job; the condition that it ends with."""
    (container,) = spec["template"]["spec"]["containers"]
    final = next(r["onExitCodes"]["values"] for r in spec["podFailurePolicy"]["rules"] if "onExitCodes" in r)
    left = spec["backoffLimit"]
    for index in range(spec["completions"]):
        environment = dict(os.environ)
        if spec["completionMode"] == "Indexed":
            environment["JOB_COMPLETION_INDEX"] = str(index)
        while True:
            # The current folder stands for the volume.
            command = [expanded(word) for word in container["command"]]
            code = subprocess.run(command, env=environment, check=False).returncode
            if code == 0:
                break
            left -= 1
            if code in final or left < 0:
                return "Failed"
    return "Complete"


def _main(name: str, words: list[str]) -> int:
    if name in PROGRAMS:
        return _program([name, *words])
    if code := _planted([name, *words]):
        return code
    return {"sbatch": _sbatch, "scontrol": _scontrol, "kubectl": _kubectl}[name](words)


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1], sys.argv[2:]))
