"""Job files for SLURM: a batch script per step, and a script that submits them with their order."""

from __future__ import annotations

import shlex
from collections.abc import Sequence

from mbtf_core.errors import UsageError
from mbtf_core.units import format_duration
from mbtf_pipeline.emit.places import Places
from mbtf_pipeline.emit.steps import Step

SUBMIT, LIBRARY, LOGS = "submit.sh", "job.sh", "logs"
# A job that has been queued again so often fails. SLURM waits two minutes before each time, and the lock of
# another machine that has crashed counts for five minutes.
_RESTARTS = 20
# Seconds before the time limit at which the program is told to store its work, and the shortest limit: SLURM
# may send the signal a minute earlier.
_NOTICE, _SHORTEST = 90, 300

_LIBRARY = """\
# Runs the program of a job; the batch scripts read this file.

# run_job NAME COMMAND…
# Shortly before the time limit (USR1), the program stores its work, and the job is queued again. So it is
# where the program exits with 4: unfinished, and the same command resumes.
run_job() {{
    local name=$1 program code again="" signaled job=$SLURM_JOB_ID
    shift
    # One of an array's tasks has the number of the whole array.
    [ -z "${{SLURM_ARRAY_TASK_ID:-}}" ] || job=${{SLURM_ARRAY_JOB_ID}}_$SLURM_ARRAY_TASK_ID
    trap 'signaled=yes again=yes; kill -TERM "$program"' USR1
    trap 'signaled=yes; kill -TERM "$program"' TERM
    "$@" &
    program=$!
    while true; do
        signaled=
        wait "$program"
        code=$?
        # A signal ends `wait`, not the program.
        [ -n "$signaled" ] || break
    done
    [ "$code" -ne 0 ] || return 0
    if [ "$code" -eq 4 ] || [ -n "$again" ]; then
        if [ "${{SLURM_RESTART_COUNT:-0}}" -lt {restarts} ]; then
            echo "$name: unfinished (exit code $code), queued again to resume" >&2
            scontrol requeue "$job" && return "$code"
        fi
    fi
    local what="failed with exit code $code, see above" also=""
    # By scancel, or before SLURM gives the node to another job and queues this one again.
    [ "$code" -ne 143 ] || what="was stopped" also=", unless SLURM starts it again itself"
    echo "$name $what. What is finished is kept;" {start} "resumes$also" >&2
    return "$code"
}}
"""

_SUBMIT = """\
#!/bin/bash
# Submits the recipe {name} to SLURM. Options of sbatch may follow, which go to every job:
#     {start} --partition=short --account=name
# Submit again to resume: finished parts are kept.
set -euo pipefail
{change}
mkdir -p -- {logs}

# submit SCRIPT LOG OPTIONS…: prints the number of the new job.
submit() {{
    local script=$1 log=$2 id
    shift 2
    id=$(sbatch --parsable --kill-on-invalid-dep=yes --output="$log" "$@" "$script") || return
    echo "${{id%%;*}}"
}}

"""


def slurm_files(name: str, places: Places, steps: Sequence[Step]) -> dict[str, str]:
    """Batch scripts of the steps, and the script that submits them.

    Parameters
    ----------
    name : str
        Name of the recipe.
    places : Places
    steps : sequence of Step

    Returns
    -------
    dict of str to str
        File name → content.

    Raises
    ------
    UsageError
        SLURM cannot write logs to the folder, or a time limit is too short.
    """
    if min(step.resources.seconds for step in steps) < _SHORTEST:
        hint = f"give {format_duration(_SHORTEST)} or more"
        raise UsageError("is too short for SLURM", where="--time-limit", hint=hint)
    if "%" in str(places.folder):
        raise UsageError("SLURM reads % in the names of logs", where="-o", hint="choose another folder")
    start = places.start(SUBMIT)
    files = {step.name + ".sbatch": _script(name, places, step) for step in steps}
    files[LIBRARY] = _LIBRARY.format(restarts=_RESTARTS, start=shlex.quote(start))
    text = _SUBMIT.format(name=name, start=start, change=places.change, logs=places.shell(LOGS))
    numbers = {step.name: f"job_{i}" for i, step in enumerate(steps, 1)}
    for step in steps:
        log = places.shell(f"{LOGS}/{step.name}-{'%A-%a' if step.slices else '%j'}.log")
        after = "".join(f":${numbers[need]}" for need in step.needs)
        dependency = f" --dependency=afterok{after}" if after else ""
        script = places.shell(f"{step.name}.sbatch")
        text += f'{numbers[step.name]}=$(submit {script} {log}{dependency} "$@")\n'
    jobs = " ".join(f"${number}" for number in numbers.values())
    text += f'echo "submitted:" {jobs}\n'
    text += f'echo "logs:" {places.shell(LOGS)}\n'
    return files | {SUBMIT: text}


def _script(name: str, places: Places, step: Step) -> str:
    resources = step.resources
    minutes = max(1, round(resources.seconds / 60))
    options = [f"--job-name={name}-{step.name}"]
    if step.slices:
        options.append(f"--array=1-{step.slices}")
    options += [f"--cpus-per-task={resources.cpus}", f"--mem={resources.mebibytes}M"]
    if resources.gpus:
        options.append(f"--gres=gpu:{resources.gpus}")
    options += [f"--time={minutes // 60:02d}:{minutes % 60:02d}:00", "--requeue", "--open-mode=append"]
    options.append(f"--signal=B:USR1@{_NOTICE}")
    what = step.name
    if step.slices:
        what = f"slice $SLURM_ARRAY_TASK_ID/{step.slices} of {step.name}"
    lines = [
        "#!/bin/bash",
        *(f"#SBATCH {option}" for option in options),
        f"# {step.title}".rstrip("\\"),
        f"source {places.start(LIBRARY)}",
        f'run_job "{what}" {step.command("$SLURM_ARRAY_TASK_ID")}',
    ]
    return "\n".join(lines) + "\n"
