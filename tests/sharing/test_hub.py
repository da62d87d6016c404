"""Models on the hub: pushed with a card in the RL Zoo's layout, pulled without running anything."""

import io
import json
import os
import pickle
import shutil
import zipfile

import pytest
import yaml
from hub_stand_in import Hub
from stable_baselines3 import SAC

from sb3_por.__main__ import main
from sb3_por.common.errors import UserError, UserNote
from sb3_por.evaluation import evaluate
from sb3_por.runs.environment import RANKED_PROGRESS, TrainingEnvironment
from sb3_por.runs.folder import read_settings, write_settings
from sb3_por.sharing.card import write_card
from sb3_por.sharing.export import export_run
from sb3_por.sharing.hub import MAX_FILE, _take_evaluations, pull, push
from sb3_por.training.zoo import main as train

NAME = "sac-Pendulum-v1"
REPO = f"somebody/{NAME}"
FILES = {
    *(f"{NAME}.zip", "README.md", "args.yml", "config.yml", "env_kwargs.yml", "results.json", "replay.mp4", "curve.png"),
    *("train_eval_metrics.zip", "vec_normalize.pkl"),
}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A short training with normalized observations."""
    folder = tmp_path_factory.mktemp("logs")
    flags = ["--algo", "sac", "--env", "Pendulum-v1", "-n", "200", "--eval-freq", "100", "--eval-episodes", "2", "--seed", "5"]
    params = ["normalize:True", "policy_kwargs:dict(net_arch=[8])", "learning_starts:50"]
    assert train([*flags, "-f", str(folder), "-params", *params]) == 0
    run = folder / "sac" / "Pendulum-v1_1"
    typed = f"/home/me/bin/python train.py --algo sac --env Pendulum-v1 -n 200 -f {folder}"
    (run / "Pendulum-v1" / "command.txt").write_text(typed)
    return run


@pytest.fixture(scope="module")
def pushed(run):
    """The files that arrive at the hub, and the requests that they came with."""
    with pytest.MonkeyPatch.context() as patch, Hub() as hub:
        patch.setenv("HF_ENDPOINT", hub.url)
        patch.setenv("HF_TOKEN", "hf_of_the_test")
        assert push(run, REPO, n_episodes=2) == f"{hub.url}/{REPO}"
        return hub.files[REPO], hub.requests


@pytest.fixture
def hub(pushed, monkeypatch):
    with Hub({REPO: pushed[0]}) as hub:
        monkeypatch.setenv("HF_ENDPOINT", hub.url)
        yield hub


def test_a_push_creates_the_repository_and_commits_once(pushed):
    files, requests = pushed
    assert set(files) == FILES
    posted = [path for method, path, token in requests if method == "POST" and token == "Bearer hf_of_the_test"]
    assert posted[0] == "/api/repos/create" and posted.count(f"/api/models/{REPO}/commit/main") == 1


def test_the_card_has_what_the_hub_lists_by(pushed):
    page = pushed[0]["README.md"].decode()
    _, front, text = page.split("---\n", 2)
    metadata = yaml.safe_load(front)
    assert metadata["library_name"] == "stable-baselines3" and "Pendulum-v1" in metadata["tags"]
    (entry,) = metadata["model-index"]
    assert entry["name"] == "SAC" and entry["results"][0]["dataset"]["type"] == "Pendulum-v1"
    results = json.loads(pushed[0]["results.json"])
    (metric,) = entry["results"][0]["metrics"]
    assert metric["type"] == "mean_reward"
    assert metric["value"] == f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    for part in (f"python -m sb3_por pull {REPO} -o {NAME}", "![learning curve](curve.png)", "replay.mp4", "net_arch"):
        assert part in text
    assert "\npython train.py --algo sac --env Pendulum-v1 -n 200\n" in text


def test_no_folder_of_the_machine_is_published(run, pushed):
    for name, content in pushed[0].items():
        texts = [content]
        if name.endswith(".zip"):
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                texts = [archive.read(member) for member in archive.namelist()]
        assert not any(str(run.parents[1]).encode() in text for text in texts), name


def test_demonstrations_and_rankers_are_published_by_their_names(run, tmp_path):
    copied = shutil.copytree(run, tmp_path / "logs" / "sac" / "Pendulum-v1_1")
    settings = {**read_settings(copied / "Pendulum-v1" / "config.yml"), "demos": "/home/me/shown"}
    settings["env_wrapper"] = [{RANKED_PROGRESS: {"ranker": "/home/me/fold.npz", "scale": 5.0}}]
    write_settings(copied / "Pendulum-v1" / "config.yml", settings)
    arguments = read_settings(copied / "Pendulum-v1" / "args.yml")
    write_settings(
        copied / "Pendulum-v1" / "args.yml", {**arguments, "demos": "/home/me/shown", "ranker": "/home/me/fold.npz"}
    )
    model = SAC.load(copied / "best_model.zip")
    model.demos = "/home/me/shown"
    TrainingEnvironment.of_settings("Pendulum-v1", settings).store_in(model)
    model.save(copied / "best_model.zip")
    (tmp_path / "card").mkdir()
    write_card(copied, tmp_path / "card", REPO, n_episodes=1)
    export_run(copied, tmp_path / "agents", n_episodes=1)
    for file in [*(tmp_path / "card").iterdir(), *(tmp_path / "agents").iterdir()]:
        texts = [file.read_bytes()]
        if file.suffix == ".zip":
            with zipfile.ZipFile(file) as archive:
                texts = [archive.read(member) for member in archive.namelist()]
        assert not any(b"/home/me" in text for text in texts), file.name
    published = read_settings(tmp_path / "card" / "config.yml")
    assert published["demos"] == "shown" and published["env_wrapper"] == [
        {RANKED_PROGRESS: {"ranker": "fold.npz", "scale": 5.0}}
    ]


def test_the_packages_that_a_repository_names_are_not_imported_later(hub, pushed, tmp_path):
    arguments = {**yaml.safe_load(pushed[0]["args.yml"]), "gym_packages": ["stranger"]}
    hub.files[REPO] = {**pushed[0], "args.yml": yaml.safe_dump(arguments).encode()}
    pull(REPO, tmp_path / "pulled")
    assert evaluate(tmp_path / "pulled", "Pendulum-v1", 1).lengths == [200]
    pull(REPO, tmp_path / "of_mine", env="toy_envs:Pendulum-v1")
    assert read_settings(tmp_path / "of_mine" / "Pendulum-v1" / "args.yml")["gym_packages"] == ["toy_envs"]


def test_the_pushed_model_is_one_of_sb3(pushed, tmp_path):
    (tmp_path / "model.zip").write_bytes(pushed[0][f"{NAME}.zip"])
    assert SAC.load(tmp_path / "model.zip").policy_kwargs["net_arch"] == [8]


def test_a_pulled_model_scores_what_its_card_tells(hub, pushed, tmp_path, capsys):
    folder = tmp_path / "new" / "pulled"
    assert main(["pull", REPO, "-o", str(folder)]) == 0
    assert capsys.readouterr().out == f"{folder}\n"
    expected = json.loads(pushed[0]["results.json"])["evaluation"]["episodes"]["returns"]
    assert evaluate(folder, "Pendulum-v1", 2).returns == expected
    found = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    settings = {"Pendulum-v1/args.yml", "Pendulum-v1/config.yml"}
    assert found == {"best_model.zip", "README.md", "results.json", "replay.mp4", "curve.png", "evaluations.npz", *settings}
    with zipfile.ZipFile(folder / "best_model.zip") as archive:
        assert b"serialized" not in archive.read("data") and "vecnormalize.json" in archive.namelist()
    assert main(["plot", str(folder), "--metric", "return", "-o", str(tmp_path / "curve.png")]) == 0
    assert main(["pull", REPO, "-o", str(folder)]) == 2
    assert "is there already" in capsys.readouterr().err


def test_unsafe_takes_the_files_as_they_are(hub, pushed, tmp_path):
    folder = pull(REPO, tmp_path / "pulled", unsafe=True)
    assert (folder / "best_model.zip").read_bytes() == pushed[0][f"{NAME}.zip"]
    assert (folder / "Pendulum-v1" / "vecnormalize.pkl").read_bytes() == pushed[0]["vec_normalize.pkl"]


class Touch:
    def __init__(self, marker):
        self.marker = str(marker)

    def __reduce__(self):
        return os.system, (f"touch {self.marker}",)


def test_hostile_repositories_are_refused_and_leave_nothing(hub, pushed, tmp_path):
    marker = tmp_path / "executed"
    evil = pickle.dumps(Touch(marker))
    with zipfile.ZipFile(io.BytesIO(pushed[0][f"{NAME}.zip"])) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}

    def model(**changes):
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w") as archive:
            for name, member in {**members, **changes}.items():
                archive.writestr(name, member)
        return content.getvalue()

    wrapper = b"env_wrapper: {timeit.timeit: {setup: \"open('executed', 'w')\"}}"
    hostile = {
        "networks": {f"{NAME}.zip": model(**{"policy.pth": evil})},
        "paths": {f"{NAME}.zip": model(**{"../../evil.pth": evil})},
        "statistics": {f"{NAME}.zip": model(**{"vecnormalize.json": b"[]"})},
        "wrapper": {"config.yml": wrapper},
        "two models": {"a2c-Pendulum-v1.zip": b""},
        "no zip": {f"{NAME}.zip": evil},
        "package": {"args.yml": b"env: antigravity:NoSuch-v0"},
    }
    for name, files in hostile.items():
        hub.files[REPO] = {**pushed[0], **files}
        with pytest.raises(UserError):
            pull(REPO, tmp_path / "pulled")
        assert not list(tmp_path.iterdir()), name
    # Names that a card does not have are not fetched
    hub.files[REPO] = {**pushed[0], "../../evil.py": b"x", "sub/sac-Pendulum-v1.zip": b"x", "setup.py": evil}
    folder = pull(REPO, tmp_path / "pulled")
    fetched = {path.partition("/resolve/main/")[2] for _, path, _ in hub.requests}
    assert not {"../../evil.py", "sub/sac-Pendulum-v1.zip", "setup.py"} & fetched and [folder] == list(tmp_path.iterdir())


def test_pickled_statistics_alone_are_refused_by_name(hub, pushed, tmp_path):
    with zipfile.ZipFile(io.BytesIO(pushed[0][f"{NAME}.zip"])) as archive:
        members = {name: archive.read(name) for name in archive.namelist() if name != "vecnormalize.json"}
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, member in members.items():
            archive.writestr(name, member)
    hub.files[REPO][f"{NAME}.zip"] = content.getvalue()
    with pytest.raises(UserError, match=r"has its statistics as a pickle, vec_normalize.pkl, alone; --unsafe takes it"):
        pull(REPO, tmp_path / "pulled")


def test_a_model_of_the_rl_zoo_is_pulled(hub, tmp_path):
    """Its settings are Python objects in YAML, and its model describes nothing."""
    model = SAC("MlpPolicy", "Pendulum-v1", buffer_size=10, policy_kwargs=dict(net_arch=[8]))
    model.save(tmp_path / "model.zip")
    config = "!!python/object/apply:collections.OrderedDict\n- - - policy\n    - MlpPolicy\n  - - n_timesteps\n    - 20000.0\n"
    hub.files["zoo/sac-Pendulum-v1"] = {
        "sac-Pendulum-v1.zip": (tmp_path / "model.zip").read_bytes(),
        "config.yml": config.encode(),
        "args.yml": b"!!python/object/apply:collections.OrderedDict\n- - - algo\n    - sac\n",
        "replay.mp4": b"video",
    }
    folder = pull("zoo/sac-Pendulum-v1", tmp_path / "pulled")
    assert evaluate(folder, "Pendulum-v1", 1) == evaluate(model, "Pendulum-v1", 1)
    assert read_settings(folder / "Pendulum-v1" / "config.yml")["n_timesteps"] == 20000.0


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["pull", "nobody/nothing", "-o", "new"], "the hub does not serve nobody/nothing: "),
        (["pull", "nothing", "-o", "new"], "'nothing' is no repository; give user/name"),
        (["pull", "somebody/empty", "-o", "new"], "holds 0 models named <algo>-<env>.zip instead of one"),
        (["pull", "somebody/huge", "-o", "new"], "sac-X-v0.zip in somebody/huge is refused: it has more than 1024 MiB"),
        (["push", "RUN", "--repo", "nothing"], "'nothing' is no repository; give user/name"),
        (["push", "nowhere", "--repo", "a/b"], "nowhere is no folder of a run"),
    ],
)
def test_what_cannot_be_shared_is_one_line(arguments, message, hub, run, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    hub.files["somebody/empty"] = {}
    hub.files["somebody/huge"] = {"sac-X-v0.zip": Huge()}
    assert main([str(run) if word == "RUN" else word for word in arguments]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


class Huge(bytes):
    def __len__(self):
        return MAX_FILE + 1


def test_a_damaged_archive_of_evaluations_is_noted_and_costs_them_alone(tmp_path):
    archive = tmp_path / "train_eval_metrics.zip"
    archive.write_bytes(b"PK no archive")
    with pytest.warns(UserNote, match="cannot read train_eval_metrics.zip, so there are no evaluations to plot"):
        _take_evaluations(archive, tmp_path)
    with zipfile.ZipFile(archive, "w") as metrics:
        metrics.writestr("evaluations.npz", b"scores")
    _take_evaluations(archive, tmp_path)
    assert (tmp_path / "evaluations.npz").read_bytes() == b"scores"
