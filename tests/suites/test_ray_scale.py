"""A suite of 200 short runs on a Ray cluster, fifty at a time. A stand-in for training makes them short."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pandas as pd
import pytest
from ray_cluster import RayCluster

ROOT = Path(__file__).parents[2]
N_RUNS, AT_A_TIME = 200, 50

#: Takes the place of ``python -m sb3_por.zoo``: writes what a run leaves. The first fifty wait for each other.
STAND_IN = f"""
import os, pathlib, sys, time

if "sb3_por.zoo" in sys.orig_argv:
    words = sys.orig_argv
    algo, env, seed, folder = (words[words.index(flag) + 1] for flag in ("--algo", "--env", "--seed", "-f"))
    begun = pathlib.Path(os.environ["BEGUN"])
    with open(begun / seed, "a") as file:
        file.write("begun\\n")
    while len(list(begun.iterdir())) < {AT_A_TIME}:
        time.sleep(0.2)
    run = pathlib.Path(folder) / algo / (env + "_1")
    (run / env).mkdir(parents=True)
    (run / env / "args.yml").write_text("algo: " + algo + "\\nenv: " + env + "\\nseed: " + seed + "\\n")
    import numpy
    numpy.savez(run / "evaluations.npz", timesteps=[100], results=[[float(seed)]], ep_lengths=[[200]])
    (run / (env + ".zip")).write_bytes(b"a model")
    os._exit(0)
"""


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed: pip install -c constraints.txt '.[ray]'")
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_two_hundred_runs_fifty_at_a_time(tmp_path):
    for name in ("nodes", "begun", "python"):
        (tmp_path / name).mkdir()
    (tmp_path / "python" / "sitecustomize.py").write_text(STAND_IN)
    (tmp_path / "grid.yml").write_text(f"algos: [sac]\nenvs: [Pendulum-v1]\nseeds: {list(range(N_RUNS))}\n")
    cluster = RayCluster(tmp_path / "nodes")
    try:
        variables = {"PYTHONPATH": f"{tmp_path / 'python'}:{ROOT}", "BEGUN": str(tmp_path / "begun")}
        cluster.start("head", cpus=AT_A_TIME, **variables)
        suite = subprocess.run(
            [sys.executable, "-m", "sb3_por", "suite", "grid.yml", "--root", "runs", "--ray", cluster.address],
            cwd=tmp_path,
            env=cluster.env | {"PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
        )
    finally:
        cluster.close()
    assert suite.returncode == 0, suite.stderr
    assert [(tmp_path / "begun" / str(seed)).read_text() for seed in range(N_RUNS)] == ["begun\n"] * N_RUNS
    scores = pd.read_csv(tmp_path / "runs" / "grid" / "scores.csv").sort_values("seed")
    assert scores["seed"].tolist() == scores["return"].tolist() == list(range(N_RUNS))
