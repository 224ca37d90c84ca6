"""Job files for Kubernetes: a Job per step, and a script that applies them one after another."""

from __future__ import annotations

import io
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mbtf_core.files.digest import data_sha256
from mbtf_pipeline.emit.places import Places
from mbtf_pipeline.emit.steps import Step, waves

APPLY = "apply.sh"
# Where the volume lies in the containers.
_MOUNT = "/work"
# Pods of an Indexed Job are named after it and their index; names have at most 63 characters.
_LONGEST = 50
# Number of a slice, for a shell.
_INDEX = "$((JOB_COMPLETION_INDEX + 1))"
# Restarts of each command, besides those after an eviction, which do not count. Kubernetes waits for ten
# seconds before the first and up to six minutes before later ones: together longer than the half hour for
# which the lock of a pod that was killed counts.
_RESTARTS = 10
# Exit codes that a repetition does not change: usage and bad input.
_FINAL = [2, 3]

_APPLY = """\
#!/bin/sh
# Applies the jobs of the recipe {name} in their order, and waits for them. Options of kubectl may follow:
#     {start} --namespace name
# Apply again to resume: finished jobs are kept, failed ones are replaced.
set -eu
{change}

# has CONDITION JOB: whether a job has it.
has() {{
    job=$2 condition=$1
    shift 2
    status=$(kubectl get "job/$job" --ignore-not-found "$@" \\
        -o jsonpath="{{.status.conditions[?(@.type==\\"$condition\\")].status}}")
    [ "$status" = True ]
}}

# start FILE JOB
start() {{
    file=$1 job=$2
    shift 2
    if has Failed "$job" "$@"; then
        kubectl delete "job/$job" "$@"
    fi
    kubectl apply -f "$file" "$@"
}}

# finish JOB
finish() {{
    job=$1
    shift
    while ! has Complete "$job" "$@"; do
        if has Failed "$job" "$@"; then
            echo "$job failed: kubectl logs --prefix -l job-name=$job" >&2
            echo "What is finished is kept;" {quoted} "resumes" >&2
            exit 1
        fi
        kubectl get "job/$job" "$@" > /dev/null
        sleep 5
    done
}}

"""


@dataclass(frozen=True)
class Cluster:
    """Where the jobs run.

    Attributes
    ----------
    image : str
        Container image that has the programs.
    volume : str
        Claim of a volume that all pods can write to, and that holds a copy of the current folder.
    """

    image: str
    volume: str = "mbtf"


def kubernetes_files(name: str, places: Places, steps: Sequence[Step], cluster: Cluster) -> dict[str, str]:
    """A Job per step, and the script that applies them.

    Parameters
    ----------
    name : str
        Name of the recipe.
    places : Places
    steps : sequence of Step
    cluster : Cluster

    Returns
    -------
    dict of str to str
        File name → content.
    """
    names = _names(name, steps)
    out = {f"{s.name}.yaml": f"# {s.title}\n{_yaml(_job(s, names, cluster))}" for s in steps}
    start = places.start(APPLY)
    text = _APPLY.format(name=name, start=start, quoted=shlex.quote(start), change=places.change)
    for wave in waves(steps):
        text += "".join(f'start {places.shell(s.name + ".yaml")} {names[s.name]} "$@"\n' for s in wave)
        text += "".join(f'finish {names[s.name]} "$@"\n' for s in wave)
    return out | {APPLY: text}


def _names(name: str, steps: Sequence[Step]) -> dict[str, str]:
    """Names of the jobs by step: lower-case letters, digits and hyphens."""
    out: dict[str, str] = {}
    for step in steps:
        text = f"{name}-{step.name}"
        short = re.sub(r"[^a-z0-9]+", "-", text.lower()).strip("-")
        if len(short) > _LONGEST or short in out.values():
            digest = data_sha256({"name": text})[:8]
            short = f"{short[: _LONGEST - 9].strip('-')}-{digest}"
        out[step.name] = short
    return out


def _job(step: Step, names: Mapping[str, str], cluster: Cluster) -> dict[str, Any]:
    resources = step.resources
    labels = {"app.kubernetes.io/name": "mbtf", "app.kubernetes.io/component": names[step.name]}
    # Kubernetes reads $$ as $, and leaves $((…)) to the shell. Its indices count from 0.
    command = "exec " + step.command("\0").replace("$", "$$").replace("\0", _INDEX)
    requests: dict[str, Any] = {"cpu": str(resources.cpus), "memory": f"{resources.mebibytes}Mi"}
    # Without a limit on cpu: one would throttle the threads of a program that counts the node's processors.
    limits: dict[str, Any] = {"memory": requests["memory"]}
    if resources.gpus:
        limits["nvidia.com/gpu"] = str(resources.gpus)
    container = {
        "name": "mbtf",
        "image": cluster.image,
        "workingDir": _MOUNT,
        "command": ["/bin/sh", "-c", command],
        "resources": {"requests": requests, "limits": limits},
        "volumeMounts": [{"name": "work", "mountPath": _MOUNT}],
    }
    pod = {
        "restartPolicy": "Never",
        "activeDeadlineSeconds": round(resources.seconds),
        "containers": [container],
        "volumes": [{"name": "work", "persistentVolumeClaim": {"claimName": cluster.volume}}],
    }
    count = max(1, step.slices)
    policy = {
        "rules": [
            {"action": "Ignore", "onPodConditions": [{"type": "DisruptionTarget", "status": "True"}]},
            {"action": "FailJob", "onExitCodes": {"operator": "In", "values": _FINAL}},
        ]
    }
    spec: dict[str, Any] = {
        "completions": count,
        "parallelism": count,
        "completionMode": "Indexed" if step.slices else "NonIndexed",
        "backoffLimit": _RESTARTS * count,
        "podFailurePolicy": policy,
        "template": {"metadata": {"labels": labels}, "spec": pod},
    }
    metadata = {"name": names[step.name], "labels": labels}
    return {"apiVersion": "batch/v1", "kind": "Job", "metadata": metadata, "spec": spec}


def _yaml(data: Mapping[str, Any]) -> str:
    """YAML whose lines are not wrapped, so that commands stay readable."""
    from ruamel.yaml import YAML

    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False
    yaml.width = 1 << 16
    yaml.sort_base_mapping_type_on_output = False  # type: ignore[assignment]
    # Labels are those of the job and of its pods: written twice, without an anchor.
    yaml.representer.ignore_aliases = lambda data: True
    stream = io.StringIO()
    yaml.dump(dict(data), stream)
    return stream.getvalue()
