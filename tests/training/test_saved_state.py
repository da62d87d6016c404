"""A model's file that was edited by hand is refused in one line that names what is wrong, before it is trained further."""

import json
import zipfile

import pytest

from sb3_por.training.zoo import main

FLAGS = ["--env", "Pendulum-v1", "--seed", "1", "--num-threads", "1", "--eval-freq", "-1"]
SMALL = {
    "sac": ["learning_starts:20", "buffer_size:200", "batch_size:8"],
    "sac_por": ["learning_starts:20", "buffer_size:200", "batch_size:8", "policy:MlpPolicy"],
    "ppo": ["n_steps:32", "batch_size:16", "n_envs:1"],
}
MISSING = object()


@pytest.fixture(scope="module")
def members(tmp_path_factory):
    """The members of the file of a model that was trained; one for each algorithm."""
    made = {}

    def read(algo):
        if algo not in made:
            folder = tmp_path_factory.mktemp(algo)
            assert main(["--algo", algo, *FLAGS, "-n", "60", "-f", str(folder), *parameters(algo)]) == 0
            with zipfile.ZipFile(folder / algo / "Pendulum-v1_1" / "Pendulum-v1.zip") as archive:
                made[algo] = {name: archive.read(name) for name in archive.namelist()}
        return made[algo]

    return read


def parameters(algo):
    return ["-params", *SMALL[algo], "policy_kwargs:{'net_arch':[8]}"]


def train_further(algo, members, folder, **changes):
    """
    :return: the exit code of ``train.py -i`` with a file whose JSON values were changed
    """
    data = {name: value for name, value in (json.loads(members["data"]) | changes).items() if value is not MISSING}
    with zipfile.ZipFile(folder / "edited.zip", "w") as archive:
        for name, content in members.items():
            archive.writestr(name, json.dumps(data) if name == "data" else content)
    flags = ["-n", "45", "--log-interval", "1", "-f", str(folder / "again")]
    return main(["--algo", algo, *FLAGS, "-i", str(folder / "edited.zip"), *flags, *parameters(algo)])


@pytest.mark.parametrize("algo", ["sac", "sac_por"])
@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"_vec_normalize_env": 3}, "it holds _vec_normalize_env, which no model saves"),
        ({"ep_success_buffer": MISSING}, "ep_success_buffer must be deque, got None"),
        ({"ep_info_buffer": "x"}, "ep_info_buffer must be deque, got 'x'"),
        ({"_n_updates": None}, "_n_updates must be Integral, got None"),
        ({"sde_sample_freq": "x"}, "sde_sample_freq must be int, got 'x'"),
        ({"policy_kwargs": 3}, "policy_kwargs must be dict, got 3"),
    ],
)
def test_a_file_that_was_edited_is_refused_in_one_line(algo, changes, message, members, tmp_path, capsys):
    content = members(algo)
    capsys.readouterr()
    assert train_further(algo, content, tmp_path, **changes) == 2
    said = capsys.readouterr().err.splitlines()
    assert message in said[-1] and not any("Traceback" in line for line in said), said
    assert not list(tmp_path.glob("again/*/*")), "no folder is left behind"


@pytest.mark.parametrize(
    ("algo", "changes", "message"),
    [
        ("ppo", {"action_noise": "x"}, "action_noise must be ActionNoise or NoneType, got 'x'"),
        ("sac_por", {"_defers_updates": "x"}, "_defers_updates must be bool, got 'x'"),
    ],
)
def test_what_no_constructor_takes_is_checked_too(algo, changes, message, members, tmp_path, capsys):
    assert train_further(algo, members(algo), tmp_path, **changes) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize("algo", SMALL)
def test_a_file_that_was_not_edited_is_trained_further(algo, members, tmp_path):
    assert train_further(algo, members(algo), tmp_path) == 0


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("algo", SMALL)
def test_no_edit_of_any_attribute_ends_in_a_traceback(algo, members, tmp_path, capsys):
    """An edit that SB3 makes good is trained; everything else is refused."""
    content = members(algo)
    unsaved = ("_vec_normalize_env", "env", "device", "policy", "replay_buffer", "rollout_buffer", "_logger")
    for name in sorted({*json.loads(content["data"]), *unsaved}):
        for value in (MISSING, 3, "x", None, {}):
            folder = tmp_path / f"{name}_{value}"[:60]
            folder.mkdir(exist_ok=True)
            assert train_further(algo, content, folder, **{name: value}) in (0, 2), (name, value)
            assert "Traceback" not in capsys.readouterr().err, (name, value)
