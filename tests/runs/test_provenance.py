"""A run's folder tells where its numbers come from, and a run that continues elsewhere says so."""

import platform
import re
import subprocess
from importlib.metadata import version

import pytest
import torch as th

from sb3_por.runs import versions
from sb3_por.runs.folder import read_settings, write_settings
from sb3_por.runs.provenance import current_provenance
from sb3_por.runs.versions import current_commit, differences
from sb3_por.training.zoo import main

FLAGS = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "60", "--eval-freq", "-1", "--num-threads", "1"]
SMALL = ["-params", "learning_starts:50", "buffer_size:100", "batch_size:8"]


def test_a_run_records_code_versions_processor_and_threads(tmp_path, monkeypatch):
    monkeypatch.setenv("ATEN_CPU_CAPABILITY", "avx2")
    assert main([*FLAGS, "-f", str(tmp_path), *SMALL]) == 0
    recorded = read_settings(tmp_path / "sac" / "Pendulum-v1_1" / "Pendulum-v1" / "args.yml")["provenance"]
    assert recorded["commit"] == current_commit() and recorded["python"] == platform.python_version()
    assert recorded["torch"] == version("torch") and recorded["numpy"] == version("numpy")
    assert recorded["threads"] == 1 and recorded["cpu_capability"] == th.backends.cpu.get_cpu_capability()
    assert recorded["ATEN_CPU_CAPABILITY"] == "avx2"
    if platform.machine() == "x86_64" and platform.system() == "Linux":
        assert {"sse2"} <= set(recorded["cpu_flags"].split())
    assert not re.search(r"\bfpu\b", recorded["cpu_flags"]), "what no numerical library asks for is left out"
    assert differences(recorded, recorded) == {}


def test_a_commit_with_changes_is_marked(tmp_path, monkeypatch):
    def git(*words):
        subprocess.run(["git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b", *words], check=True)

    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "file").write_text("one")
    monkeypatch.setattr(versions, "__file__", str(tmp_path / "a" / "b" / "c.py"))
    assert current_commit() == ""
    for words in (("init", "-q"), ("add", "-A"), ("commit", "-q", "-m", "one")):
        git(*words)
    assert re.fullmatch(r"[0-9a-f]{12}", current_commit())
    (tmp_path / "file").write_text("two")
    assert re.fullmatch(r"[0-9a-f]{12}\+", current_commit())


@pytest.mark.parametrize("known", [True, False])
def test_a_run_that_continues_elsewhere_says_and_records_what_differs(known, tmp_path, capsys):
    assert main([*FLAGS, "-f", str(tmp_path), *SMALL]) == 0
    run = tmp_path / "sac" / "Pendulum-v1_1"
    file = run / "Pendulum-v1" / "args.yml"
    arguments = read_settings(file)
    if known:
        arguments["provenance"] |= {"torch": "2.8.0", "processor": "another", "MKL_CBWR": "AVX2"}
    else:  # a run of an earlier version
        del arguments["provenance"]
    write_settings(file, arguments)
    capsys.readouterr()
    assert main(["--resume", str(run), "-n", "70"]) == 0
    told = [line for line in capsys.readouterr().err.splitlines() if "numbers may differ" in line]
    now = current_provenance(1)
    changes = f"MKL_CBWR AVX2 -> none, processor another -> {now['processor']}, torch 2.8.0 -> {now['torch']}"
    assert told == ([f"note: the run continues where its numbers may differ in the last bits: {changes}"] if known else [])
    again = read_settings(file)
    recorded = [{"torch": now["torch"], "processor": now["processor"], "MKL_CBWR": None}] if known else []
    assert again.get("resumed_with", []) == recorded
    assert again.get("provenance") == arguments.get("provenance"), "where it began"
