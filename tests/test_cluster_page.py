"""docs/cluster.md: every command in it is understood, and the scripts for Slurm run with stand-ins for its programs."""

import json
import os
import re
import shlex
import stat
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest
from command_lines import blocks, read_by_command
from containers import IMAGE, STAGES

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "cluster.md").read_text(encoding="utf-8")
LINES = [shlex.split(line, comments=True) for block in blocks(PAGE, "sh") for line in block.splitlines()]
MAP, PRETRAIN = blocks(PAGE, "bash")
STAND_IN = f"""#!{sys.executable}
import json, os, sys
name, *words = [os.path.basename(sys.argv[0]), *sys.argv[1:]]
with open("started.txt", "a") as file:
    file.write(json.dumps([name, *words]) + "\\n")
if name == "scontrol":
    print(*[f"node{{k}}" for k in range(int(os.environ["SLURM_JOB_NUM_NODES"]))], sep="\\n")
if name == "srun":
    while words[0].startswith("--"):
        words = words[2:]
    os.execvp(words[0], words)
sys.exit(name == "ray" and "DEAD" in os.environ)
"""
posix = pytest.mark.skipif(os.name != "posix", reason="bash scripts")


def understood(words: Sequence[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Raises, or exits, when a program does not know its options."""
    match words:
        case ["tidefield", *_]:
            assert read_by_command(words, monkeypatch) == 1
        case ["ray", command, *options]:
            scripts = pytest.importorskip("ray.scripts.scripts", reason="Ray is not installed")
            scripts.cli.commands[command].make_context(command, list(options))
        case ["torchrun", *options]:
            from torch.distributed.run import get_args_parser

            found = get_args_parser().parse_args(options)
            assert found.module
            assert found.training_script == "tidefield.cli"
            understood(["tidefield", *found.training_script_args], monkeypatch)
        case ["docker" | "podman", "build", "--file", file, "--target", stage, "--tag", tag, "."]:
            assert (ROOT / file).is_file()
            assert stage in STAGES
            assert tag == f"tidefield:{stage}"
        case ["docker" | "podman", "run", *options]:
            at = next(k for k, word in enumerate(options) if IMAGE.fullmatch(word))
            assert options[at].removeprefix("tidefield:") in STAGES
            program = options[options.index("--entrypoint") + 1] if "--entrypoint" in options else "tidefield"
            understood([program, *options[at + 1 :]], monkeypatch)
        case ["docker", "exec", _, *inner]:
            understood(inner, monkeypatch)
        case ["sbatch", *_, "--wrap", line]:
            understood(shlex.split(line), monkeypatch)
        case ["export", *_] | ["pip", "install", *_, "s3fs"]:
            pass
        case _:
            pytest.fail(f"nothing is known of {shlex.join(words)}")


@pytest.mark.parametrize("words", LINES, ids=shlex.join)
def test_every_command_is_understood(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    understood(words, monkeypatch)


def run_job(script: str, folder: Path, nodes: int, *words: str, dead: bool = False) -> tuple[int, list[list[str]]]:
    """Exit status of a script for Slurm, and the commands that it started."""
    (folder / "bin").mkdir()
    for name in ("scontrol", "srun", "ray", "torchrun", "tidefield", "sleep"):
        program = folder / "bin" / name
        program.write_text(STAND_IN)
        program.chmod(program.stat().st_mode | stat.S_IXUSR)
    environment = {
        "PATH": f"{folder / 'bin'}:{os.environ['PATH']}", "USER": "me", "SLURM_JOB_ID": "7",
        "SLURM_JOB_NUM_NODES": str(nodes), "SLURM_JOB_NODELIST": f"node[0-{nodes - 1}]", "SLURM_CPUS_PER_TASK": "3",
        **({"DEAD": "1"} if dead else {}),
    }  # fmt: skip
    (folder / "job.sh").write_text(script + "wait\n")
    done = subprocess.run(["bash", "job.sh", *words], cwd=folder, env=environment, timeout=60)
    return done.returncode, [json.loads(line) for line in (folder / "started.txt").read_text().splitlines()]


@posix
@pytest.mark.parametrize("nodes", [1, 4])
def test_a_job_starts_a_head_then_workers_and_the_command(
    nodes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    status, started = run_job(MAP, tmp_path, nodes)
    assert status == 0
    for words in started:
        if words[0] in ("ray", "tidefield"):
            understood(words, monkeypatch)
    heads = [words for words in started if words[:3] == ["ray", "start", "--head"]]
    workers = [words for words in started if words[:3] == ["ray", "start", "--address"]]
    steps = [" ".join(words) for words in started if words[0] == "srun"]
    assert len(heads) == 1
    assert any("--nodelist node0 ray start --head" in step for step in steps)
    assert len(workers) == (nodes > 1)
    assert any("--nodes 3 --ntasks 3 --exclude node0 ray start" in step for step in steps) == (nodes > 1)
    assert all("--num-cpus 3" in " ".join(words) for words in heads + workers)
    (command,) = [words for words in started if words[0] == "tidefield"]
    assert command[-2:] == ["--cluster", "node0:6379"]


@posix
def test_a_job_whose_head_dies_ends(tmp_path: Path) -> None:
    status, started = run_job(MAP, tmp_path, 2, dead=True)
    assert status != 0
    assert not [words for words in started if words[0] == "tidefield"]


@posix
def test_a_job_trains_on_all_machines_and_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    status, started = run_job(PRETRAIN, tmp_path, 2, "--resume")
    assert status == 0
    (words,) = [words for words in started if words[0] == "torchrun"]
    understood(words, monkeypatch)
    assert words[-1] == "--resume"
    assert " --nnodes 2 " in shlex.join(words)
    assert " --rdzv-endpoint node0:29500 " in shlex.join(words)
    processes = words[words.index("--nproc-per-node") + 1]
    assert re.search(rf"^#SBATCH .*--gpus-per-node {processes}$", PRETRAIN, flags=re.MULTILINE)
