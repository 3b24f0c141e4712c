"""The files under examples/cluster, as far as one machine can try them."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import psutil
import pytest
import yaml
from distributed.cli import dask_scheduler, dask_worker

FOLDER = Path(__file__).parents[2] / "examples" / "cluster"

COMMAND = """
import os, sys
sys.path.insert(0, sys.argv[1])
import doomed
from autoalign.batch.cluster import DaskEngine
if __name__ == "__main__":
    engine = DaskEngine(scheduler=os.environ["AUTOALIGN_SCHEDULER"])
    print(sorted(str(outcome.result) for outcome in engine.run(doomed.fall, ["one", "segfault", "two"])))
"""


def test_the_cluster_on_this_machine_runs_a_command_and_is_gone(tmp_path: Path) -> None:
    script = tmp_path / "command.py"
    script.write_text(COMMAND)
    here = Path(__file__).parent
    environment = os.environ | {
        "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(here),
        "TMPDIR": str(tmp_path),
    }
    command = [str(FOLDER / "local.sh"), sys.executable, str(script), str(here)]
    ended = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=100)

    assert ended.stdout == "['None', 'survived one', 'survived two']\n", ended.stderr[-2000:]
    assert ended.returncode == 0
    assert [path for path in tmp_path.iterdir() if path != script] == []
    assert [p.pid for p in psutil.process_iter(["cmdline"]) if str(tmp_path) in " ".join(p.info["cmdline"] or [])] == []


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.sh")), ids=lambda path: path.name)
def test_scripts_parse(path: Path) -> None:
    shell = path.read_text().splitlines()[0].removeprefix("#!")
    assert shutil.which(shell), f"{shell} is needed for this test"
    assert os.access(path, os.X_OK)
    subprocess.run([shell, "-n", str(path)], check=True)


def test_the_manifest_is_a_cluster_and_a_job_on_it() -> None:
    cluster, job = yaml.safe_load_all((FOLDER / "kubernetes.yaml").read_text())
    (batch,) = job["spec"]["template"]["spec"]["containers"]
    (scheduler,) = (variable["value"] for variable in batch["env"] if variable["name"] == "AUTOALIGN_SCHEDULER")

    assert (cluster["kind"], job["kind"]) == ("DaskCluster", "Job")
    # The operator names the service of the scheduler after the cluster.
    assert (
        scheduler
        == f"tcp://{cluster['metadata']['name']}-scheduler:{cluster['spec']['scheduler']['service']['ports'][0]['port']}"
    )


@pytest.mark.parametrize("path", sorted(path for path in FOLDER.iterdir()), ids=lambda path: path.name)
def test_dask_knows_the_options_that_are_used(path: Path) -> None:
    text = re.sub(r"[\[\],]", "", path.read_text())  # lists in YAML
    for command, program in (("scheduler", dask_scheduler), ("worker", dask_worker)):
        known = {name for option in program.main.params for name in (*option.opts, *option.secondary_opts)}
        lines = re.findall(rf"dask {command}.*", text)
        assert lines, command
        assert {option for line in lines for option in re.findall(r"(?<!\S)--[a-z-]+", line)} <= known
