"""What a process may use of its machine."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from tidefield import machine
from tidefield.machine import memory_bytes
from tidefield.model.cache import LEAST_BYTES, MEMORY_SHARE, memory_for_features


@pytest.mark.skipif(not hasattr(os, "sysconf"), reason="the system does not say")
def test_memory_is_the_machine_s_or_its_container_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    limit = tmp_path / "memory.max"
    monkeypatch.setattr(machine, "CONTAINER_LIMITS", (tmp_path / "none", limit))
    monkeypatch.setattr(machine, "OWN_GROUPS", tmp_path / "cgroup")
    own = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert memory_bytes() == own
    for text, expected in (("max\n", own), (f"{own // 3}\n", own // 3), (f"{3 * own}\n", own)):
        limit.write_text(text)
        assert memory_bytes() == expected


@pytest.mark.skipif(not hasattr(os, "sysconf"), reason="the system does not say")
@pytest.mark.parametrize(
    ("groups", "limit"),
    [
        ("0::/slurm/job_7/step_0\n", "slurm/job_7/memory.max"),
        ("4:cpu,cpuacct:/a\n3:memory:/slurm/job_7\n0::/\n", "memory/slurm/job_7/memory.limit_in_bytes"),
    ],
)
def test_memory_is_that_of_a_job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, groups: str, limit: str):
    (tmp_path / "groups").write_text(groups)
    files = tmp_path / "memory.max", tmp_path / "memory" / "memory.limit_in_bytes"
    monkeypatch.setattr(machine, "CONTAINER_LIMITS", files)
    monkeypatch.setattr(machine, "OWN_GROUPS", tmp_path / "groups")
    (tmp_path / limit).parent.mkdir(parents=True)
    (tmp_path / limit).write_text("1000000\n")
    assert memory_bytes() == 1_000_000


def test_features_have_a_share_of_the_memory_and_workers_of_one_core_a_part_of_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("tidefield.model.cache.memory_bytes", lambda: 64_000_000_000)
    monkeypatch.setattr("tidefield.model.cache.cores", lambda: 16)
    for threads, expected in (
        (16, MEMORY_SHARE * 64e9),
        (8, MEMORY_SHARE * 32e9),
        (1, LEAST_BYTES),
        (32, MEMORY_SHARE * 64e9),
    ):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        assert memory_for_features(torch.device("cpu")) == expected


@pytest.mark.skipif(sys.platform == "win32", reason="needs a script that the system runs")
def test_gpus_are_those_of_the_driver_where_torch_is_not_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delitem(sys.modules, "torch")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert machine.describe()["machine"]["gpus"] == [], "without a driver"
    program = tmp_path / "nvidia-smi"
    program.write_text("#!/bin/sh\necho NVIDIA H200\necho NVIDIA H200\n")
    program.chmod(0o755)
    assert machine.describe()["machine"]["gpus"] == ["NVIDIA H200", "NVIDIA H200"]


KEPT = """
import numpy as np
from tidefield.machine import release_memory, tune_process

def resident():
    with open("/proc/self/status") as status:
        return int(next(line for line in status if line.startswith("VmRSS")).split()[1]) / 1000

tune_process()
large = [np.ones(5_000_000) for _ in range(10)]
del large
kept = resident()
release_memory()
print(kept, resident())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="glibc keeps memory, other C libraries do not")
def test_memory_that_is_kept_for_the_next_step_can_be_given_back():
    done = subprocess.run([sys.executable, "-c", KEPT], capture_output=True, text=True, check=True)
    kept, left = map(float, done.stdout.split())
    if kept < 300:
        pytest.skip("this C library keeps nothing")
    assert left < 0.5 * kept  # megabytes
